// A page of charts and tables: whatever its data says, it sets no option of the charting library.

(async () => {
  const specs = JSON.parse(await unpacked("charts"));
  for (const spec of Object.values(specs)) delete spec.usermeta;
  await drawAll(specs);
})();
