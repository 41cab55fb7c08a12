// What the cameras of each viewer saw, with a box around each vehicle that its sensors list.

// What viewers that answered alone were shown: their own cameras' picture, another in its place, or none.
function shownTo(answers, viewers) {
  const own = answers.filter((a) => a.role === "ego" || a.role === "helper");
  const of = (picture) => viewers.filter((id) => own.some((a) => a.viewer === id && a.picture === picture)).join(", ");
  const [seen, blank, another, not] = ["own", "blank", "another", undefined].map(of);
  return [
    seen && `The model was shown the picture of ${seen}.`,
    blank && `The model was shown a blank picture in place of that of ${blank}.`,
    another && `The model was shown another scene's picture in place of that of ${another}.`,
    not && `The model was not shown ${seen ? `the picture of ${not}` : "these pictures"}: the prompt is text alone.`,
  ].filter(Boolean).join(" ");
}

function cameraFrame(world, viewer, { picture, size: [width, height], boxes }) {
  const { role, seen } = world.viewers[viewer], [ego] = Object.keys(world.viewers);
  const vehicle = (id) => world.vehicles.find((v) => v.id === id);
  const named = (ids) => [...new Set(ids)].map((id) => `${id} ${vehicle(id).kind}`).join(", ") || "nobody";
  const [front, rear] = [false, true].map((low) => boxes.filter((box) => box[2] >= height / 2 === low).map(([id]) => id));
  const beyond = seen.filter((id) => !front.includes(id) && !rear.includes(id));
  const told = `What the cameras of ${viewer} (${role}) saw. Front: ${named(front)}. Rear: ${named(rear)}.`
    + (beyond.length ? ` Listed by its sensors, but not in the picture: ${named(beyond)}.` : "");
  const drawing = svg("svg", { viewBox: `0 0 ${width} ${height}`, class: "frame", role: "img", "aria-label": told },
    svg("image", { href: picture, width, height }));
  const outlines = boxes.map(([, left, top, right, bottom]) => [left - 1, top - 1, right + 1, bottom + 1]), taken = [...outlines];
  boxes.forEach(([id], n) => {
    const [x, y, right, bottom] = outlines[n], place = { x, y, width: right - x, height: bottom - y };
    drawing.append(svg("rect", { ...place, class: "box under" }), svg("rect", { ...place, class: `box ${vehicle(id).part}` }));
  });
  boxes.forEach(([id, left, top, right, bottom]) => {
    const half = top < height / 2 ? [0, 0, width, height / 2] : [0, height / 2, width, height];
    const [x, y] = placed(taken, half, (left + right) / 2, (top + bottom) / 2, 6 * id.length, 10, (bottom - top) / 2 + 1);
    drawing.append(svg("text", { x, y, class: "box label" }, id));
  });
  const more = role === "ego" ? [] : seen.filter((id) => id !== ego && !world.viewers[ego].seen.includes(id));
  return h("figure", {}, drawing, h("figcaption", {}, h("strong", {}, viewer), `, ${role}`,
    more.length > 0 && `; sees ${more.join(", ")}, which ${ego} does not`,
    beyond.length > 0 && h("small", {}, `listed, not in the picture: ${beyond.join(", ")}`)));
}
