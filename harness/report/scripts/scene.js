// A scene from above, north up: who is where, what one vehicle sees of it, and the messages of one decision.

const points = (list) => list.map(([x, y]) => `${x},${-y}`).join(" ");

function corners(v) {
  const cos = Math.cos(v.heading), sin = Math.sin(v.heading), l = v.length / 2, w = v.width / 2;
  return [[l, w], [l, -w], [-l, -w], [-l, w]].map(([a, b]) => [v.x + a * cos - b * sin, v.y + a * sin + b * cos]);
}

const line = (a, b, cls) => svg("line", { x1: a[0], y1: -a[1], x2: b[0], y2: -b[1], class: cls });

const overlap = (a, b) =>
  Math.max(0, Math.min(a[2], b[2]) - Math.max(a[0], b[0])) * Math.max(0, Math.min(a[3], b[3]) - Math.max(a[1], b[1]));

// The first of some places around a vehicle where its label covers nothing that was placed before.
function placed(taken, half, x, y, width, height, away) {
  const around = [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, 1], [1, -1], [-1, -1]];
  let best, least = Infinity;
  for (const reach of [1, 2.2]) {
    for (const [dx, dy] of around) {
      const cx = x + dx * (away * reach + width / 2), cy = y + dy * (away * reach + height / 2);
      const box = [cx - width / 2, cy - height / 2, cx + width / 2, cy + height / 2];
      const covered = taken.reduce((sum, other) => sum + overlap(box, other), 0);
      const outside = width * height - overlap(box, [-half, -half, half, half]);
      const cost = covered + 4 * outside + (reach > 1 ? 1 : 0);
      if (cost < least) [least, best] = [cost, [cx, cy, box]];
    }
  }
  taken.push(best[2]);
  return best;
}

function birdsEye(world, ground, viewer, messages, half) {
  const eye = world.vehicles.find((v) => v.id === viewer), sees = world.viewers[viewer];
  const seen = new Set([viewer, ...sees.seen]);
  const ego = world.vehicles.find((v) => v.part === "ego") ?? eye;
  const size = half / 23, within = (v) => Math.abs(v.x) < half - 1 && Math.abs(v.y) < half - 1;
  const hidden = world.vehicles.filter((v) => !seen.has(v.id)).map((v) => v.id);
  const listed = (names) => names.join(", ") || "none";
  const beyond = world.vehicles.filter((v) => !within(v)).map((v) => v.id);
  const told = `${viewer} (${sees.role}) sees ${listed(sees.seen)}; hidden: ${listed(hidden)}; `
    + `occluded sectors: ${listed(sees.occluded)}${beyond.length ? `; beyond the picture: ${listed(beyond)}` : ""}`;
  const viewBox = `${-half} ${-half} ${2 * half} ${2 * half}`;
  const picture = svg("svg", { viewBox, class: "scene", role: "img", "aria-label": told });
  picture.append(
    ...world.buildings.map((b) => svg("polygon", { points: points(b.corners), class: "building" })),
    svg("polygon", { points: points(ground.outline), class: "road" }),
    ...ground.marks.map((m) => svg("polyline", { points: points(m), class: "mark" })),
    ...ground.stops.map((s) => svg("polyline", { points: points(s), class: "stop" })),
    ...world.vehicles.filter((v) => v !== eye && seen.has(v.id)).map((v) => line([eye.x, eye.y], [v.x, v.y], "sight")),
  );
  const taken = world.vehicles.filter(within).map((v) => {
    const r = v.length / 2;
    return [v.x - r, -v.y - r, v.x + r, -v.y + r];
  });
  for (const v of world.vehicles) {
    if (!within(v)) continue;
    const marks = [v.part !== "other" && v.part, !seen.has(v.id) && "hidden", v.crashed && "crashed"];
    const shape = corners(v);
    const nose = [v.x + (Math.cos(v.heading) * v.length) / 2, v.y + (Math.sin(v.heading) * v.length) / 2];
    const tip = [nose[0] + Math.cos(v.heading) * v.speed, nose[1] + Math.sin(v.heading) * v.speed];
    picture.append(svg("g", { class: `vehicle ${v.part}${seen.has(v.id) ? "" : " unseen"}` },
      svg("title", {}, `${v.id}, ${v.kind}, ${v.speed} m/s`),
      svg("polygon", { points: points(shape) }),
      svg("polyline", { points: points([shape[1], nose, shape[0]]), class: "nose" }),
      v.speed > 0.5 ? line(nose, tip, "speed") : null,
      v.part === "danger" && svg("path", { d: `M${v.x} ${-v.y - 4.6}l4.6 4.6l-4.6 4.6l-4.6 -4.6z`, class: "ring" })));
    const text = [v.id, ...marks.filter(Boolean)].join(" ");
    const [x, y] = placed(taken, half, v.x, -v.y, text.length * size * 0.58, size * 1.1, v.length / 2 + 0.5);
    picture.append(svg("text", { x, y, "font-size": size, class: `label ${v.part}` }, text));
  }
  for (const c of sees.conflicts) {
    const when = (s) => (s == null ? "stands" : s < 0 ? "is past it" : `in ${s.toFixed(1)} s`);
    const told = `${ego.id} ${when(c.ego)}, ${c.with} ${when(c.other)}`;
    const cross = `M${c.x - 1.3} ${-c.y - 1.3}l2.6 2.6m0 -2.6l-2.6 2.6`;
    picture.append(svg("path", { d: cross, class: "conflict" }, svg("title", {}, `paths cross: ${told}`)));
    const [x, y] = placed(taken, half, c.x, -c.y, told.length * size * 0.5, size, 1.8);
    picture.append(svg("text", { x, y, "font-size": size * 0.85, class: "label crossing" }, told));
  }
  for (const m of messages) {
    const sender = world.vehicles.find((v) => v.id === m.from);
    if (!sender) continue;
    const kind = m.on_time ? "ontime" : m.delivered ? "late" : "lost";
    const told = m.delivered ? `${m.arrival_ms.toFixed(0)} ms${m.on_time ? "" : ", late"}` : "lost";
    picture.append(line([sender.x, sender.y], [ego.x, ego.y], `message ${kind}`));
    const at = m.delivered ? 0.55 : 0.4;
    const x = sender.x + (ego.x - sender.x) * at, y = -(sender.y + (ego.y - sender.y) * at);
    const [lx, ly] = placed(taken, half, x, y, told.length * size * 0.55, size, 0.6);
    picture.append(svg("text", { x: lx, y: ly, "font-size": size * 0.9, class: `label ${kind}` }, told));
  }
  return [picture, told];
}

const KEY = "Blue: ego; green: helper; red with a ring: the dangerous vehicle; dashed: hidden from the viewer. "
  + "Thin lines: sight. Ahead of a vehicle its way in 1 s, × where paths cross. Thick lines to the ego: replies.";
const LOOKS = [
  "fill", "stroke", "stroke-width", "stroke-dasharray", "stroke-linejoin", "vector-effect", "opacity", "font-family",
  "font-weight", "text-anchor", "dominant-baseline", "paint-order",
];

// The picture with its look inside, as it has to stand alone.
async function saved(picture, id, kind) {
  const copy = picture.cloneNode(true), to = copy.querySelectorAll("*");
  picture.querySelectorAll("*").forEach((element, n) => {
    const look = getComputedStyle(element);
    to[n].setAttribute("style", LOOKS.map((name) => `${name}:${look.getPropertyValue(name)}`).join(";"));
  });
  copy.setAttribute("xmlns", "http://www.w3.org/2000/svg");
  const side = 1200, paper = getComputedStyle(picture).backgroundColor;
  copy.setAttribute("style", `background:${paper}`);
  copy.setAttribute("width", side);
  copy.setAttribute("height", side);
  const text = new XMLSerializer().serializeToString(copy);
  if (kind === "svg") return download(`scene-${id}.svg`, new Blob([text], { type: "image/svg+xml" }));
  const image = new Image(), canvas = h("canvas", { width: side, height: side });
  image.src = `data:image/svg+xml,${encodeURIComponent(text)}`;
  await image.decode();
  canvas.getContext("2d").drawImage(image, 0, 0);
  canvas.toBlob((content) => download(`scene-${id}.png`, content));
}
