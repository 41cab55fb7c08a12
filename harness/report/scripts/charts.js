// Charts by Vega-Lite. Its library is unpacked only when the first chart is wanted, after the page can be read.

let library;
function vega() {
  library ??= unpacked("vega").then((code) => {
    // The page's policy lets exactly this text run.
    const script = document.createElement("script");
    script.textContent = code;
    document.head.append(script);
    return window.vegaEmbed;
  });
  return library;
}

const LOOK = {
  background: null,
  font: "system-ui, 'DejaVu Sans', sans-serif",
  view: { stroke: null },
  axis: {
    labelColor: "currentColor", titleColor: "currentColor", domainColor: "currentColor", tickColor: "currentColor",
    gridColor: "currentColor", gridOpacity: 0.14, titleFontWeight: "normal", labelFontSize: 11, titleFontSize: 11.5,
  },
  legend: {
    labelColor: "currentColor", titleColor: "currentColor", titleFontWeight: "normal",
    symbolLimit: 0, symbolBaseFillColor: "currentColor", symbolBaseStrokeColor: "currentColor",
  },
};

const widest = (names) => 6.5 * Math.max(0, ...names.map((name) => name?.length ?? 0));

// In a legend names stand in as many columns as the longest has room for, and legends below each other: what is
// wider than its chart would be cut.
function legend(spec, width) {
  const names = [];
  JSON.stringify(spec, (key, value) => {
    if (key === "domain" && typeof value?.[0] === "string") names.push(...value);
    return value;
  });
  const axis = Math.max(Math.min(widest((spec.data.values ?? []).map((row) => row.bar)), 260), 50);
  const room = Math.max(width - axis - 24, 80); // right of where the chart's own axis ends
  return {
    ...LOOK.legend, columns: Math.min(Math.max(Math.floor(room / (widest(names) + 36)), 1), 4), labelLimit: room - 36,
    layout: { top: { direction: "vertical", anchor: "start" } },
  };
}

async function chart(place, name, spec, values = {}) {
  const embed = await vega();
  const found = await embed(place, spec, {
    ast: true, // expressions are interpreted: the page's policy forbids to compile them
    renderer: "svg",
    config: { ...LOOK, legend: legend(spec, place.clientWidth) },
    actions: { export: { svg: true, png: true }, source: false, compiled: false, editor: false },
    downloadFileName: name,
    tooltip: { disableDefaultStyle: true },
    defaultStyle: false,
    scaleFactor: { png: 2 },
    patch: (compiled) => {
      for (const data of compiled.data) if (data.name in values) data.values = values[data.name];
      return compiled;
    },
  });
  return found.view;
}

function tableOf(spec) {
  const rows = spec.data.values;
  const names = Object.keys(rows[0] ?? {}).filter((name) => name !== "order");
  return [names, ...rows.map((row) => names.map((name) => row[name]))];
}

// On a telephone a chart is as wide as it can be, and less high: the page's first is seen without scrolling.
const low = (spec, width) => (spec.layer ? { ...spec, height: Math.min(spec.height, 0.6 * width) } : spec);

async function drawAll(specs) {
  for (const place of document.querySelectorAll("[data-chart]")) {
    const name = place.dataset.chart, spec = specs[name];
    try {
      await chart(place, name, low(spec, place.clientWidth));
    } catch (error) {
      place.replaceChildren(h("p", { class: "bad" }, `This chart cannot be drawn: ${error.message}`));
    }
    (place.querySelector(".vega-actions") ?? place).append(copyButton(() => tableOf(spec)));
    await new Promise((done) => setTimeout(done)); // the page answers between two charts
  }
  document.body.dataset.drawn = "true";
}
