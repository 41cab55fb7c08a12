// A scene from above, north up: who is where, what one vehicle sees of it, and the messages of one decision.

const points = (list) => list.map(([x, y]) => `${x},${-y}`).join(" ");

function corners(v) {
  const cos = Math.cos(v.heading), sin = Math.sin(v.heading), l = v.length / 2, w = v.width / 2;
  return [[l, w], [l, -w], [-l, -w], [-l, w]].map(([a, b]) => [v.x + a * cos - b * sin, v.y + a * sin + b * cos]);
}

const line = (a, b, cls) => svg("line", { x1: a[0], y1: -a[1], x2: b[0], y2: -b[1], class: cls });

const overlap = (a, b) =>
  Math.max(0, Math.min(a[2], b[2]) - Math.max(a[0], b[0])) * Math.max(0, Math.min(a[3], b[3]) - Math.max(a[1], b[1]));

// The first of some places around what a label names where it covers nothing that was placed before.
function placed(taken, view, x, y, width, height, away) {
  const around = [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, 1], [1, -1], [-1, -1]];
  let best, least = Infinity;
  for (const reach of [0, 1, 2.5, 5]) {
    for (const [dx, dy] of around) {
      const far = away + reach * height;
      const cx = x + dx * (far + width / 2), cy = y + dy * (far + height / 2);
      const box = [cx - width / 2, cy - height / 2, cx + width / 2, cy + height / 2];
      const covered = taken.reduce((sum, other) => sum + overlap(box, other), 0);
      const outside = width * height - overlap(box, view);
      const cost = covered + 4 * outside + 0.02 * reach * width * height;
      if (cost < least) [least, best] = [cost, [cx, cy, box, reach]];
    }
  }
  taken.push(best[2]);
  return best;
}

// What lies behind walls and vehicles as seen from the middle of one, which is where its rays begin.
function shadows(world, eye, far) {
  const shapes = [...world.buildings.map((b) => b.corners), ...world.vehicles.filter((v) => v !== eye).map(corners)];
  const beyond = ([x, y]) => {
    const dx = x - eye.x, dy = y - eye.y, length = Math.hypot(dx, dy) || 1;
    return [x + (dx / length) * far, y + (dy / length) * far];
  };
  return svg("g", { class: "shadow" }, shapes.flatMap((shape) => shape.map((a, n) => {
    const b = shape[(n + 1) % shape.length];
    return svg("polygon", { points: points([a, b, beyond(b), beyond(a)]) });
  })));
}

// `zoom` is all, or the west and south ends of a square and its side; else what the messages need is shown.
// `agents` are those that decide in the same step: each with its id, what it decided and its page.
// `common` is the ground of all scenes; one whose layout has a road of its own brings its own.
function birdsEye(world, common, viewer, messages, zoom, agents) {
  const ground = world.ground ?? common;
  const eye = world.vehicles.find((v) => v.id === viewer), sees = world.viewers[viewer];
  const seen = new Set([viewer, ...sees.seen]), most = ground.view_m;
  const ego = world.vehicles.find((v) => v.part === "ego") ?? eye;
  const [west, south, side] = zoom === "all" ? [-most, -most, 2 * most] : Array.isArray(zoom) ? zoom : sees.views[messages.map((m) => m.from).join(" ")];
  const north = -south - side;
  const view = [west, north, west + side, north + side], size = side / 38;
  const within = (v) => v.x > west + 1 && v.x < view[2] - 1 && -v.y > north + 1 && -v.y < view[3] - 1;
  const hidden = world.vehicles.filter((v) => !seen.has(v.id)).map((v) => v.id);
  const listed = (names) => names.join(", ") || "none";
  const beyond = world.vehicles.filter((v) => !within(v)).map((v) => v.id);
  const told = `${viewer} (${sees.role}) sees ${listed(sees.seen)}; hidden: ${listed(hidden)}; `
    + `occluded sectors: ${listed(sees.occluded)}${beyond.length ? `; beyond the picture: ${listed(beyond)}` : ""}`;
  const picture = svg("svg", { viewBox: `${west} ${north} ${side} ${side}`, class: "scene", role: "img", "aria-label": told });
  picture.append(
    svg("path", { d: ground.outlines.map((o) => `M${points(o)}Z`).join(""), class: "road", "fill-rule": "evenodd" }),
    ...ground.marks.map((m) => svg("polyline", { points: points(m), class: "mark" })),
    ...ground.stops.map((s) => svg("polyline", { points: points(s), class: "stop" })),
    shadows(world, eye, 4 * most),
    ...world.buildings.map((b) => svg("polygon", { points: points(b.corners), class: "building" })),
    ...world.vehicles.filter((v) => v !== eye && seen.has(v.id)).map((v) => line([eye.x, eye.y], [v.x, v.y], "sight")),
  );
  const taken = world.vehicles.filter(within).map((v) => {
    const [xs, ys] = [0, 1].map((k) => corners(v).map((corner) => (k ? -corner[k] : corner[k])));
    return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  });
  taken.push(...sees.conflicts.map((c) => [c.x - 1.5, -c.y - 1.5, c.x + 1.5, 1.5 - c.y]));
  const label = (text, x, y, away, kind) => {
    const [lx, ly, box, reach] = placed(taken, view, x, y, text.length * size * 0.56, size * 1.15, away);
    if (reach > 1) {
      const end = [Math.min(Math.max(x, box[0]), box[2]), Math.min(Math.max(y, box[1]), box[3])];
      picture.append(svg("line", { x1: x, y1: y, x2: end[0], y2: end[1], class: "leader" }));
    }
    picture.append(svg("text", { x: lx, y: ly, "font-size": size, class: `label ${kind}` }, text));
  };
  for (const v of world.vehicles) {
    if (!within(v)) continue;
    const shape = corners(v);
    const nose = [v.x + (Math.cos(v.heading) * v.length) / 2, v.y + (Math.sin(v.heading) * v.length) / 2];
    const tip = [nose[0] + Math.cos(v.heading) * v.speed, nose[1] + Math.sin(v.heading) * v.speed];
    const agent = agents.find((each) => each.id === v.id && !each.here);
    picture.append(svg(agent ? "a" : "g", { ...(agent && { href: agent.href }), class: `vehicle ${v.part}${seen.has(v.id) ? "" : " unseen"}` },
      svg("title", {}, `${v.id}, ${v.kind}, ${v.speed} m/s${seen.has(v.id) ? "" : `, hidden from ${viewer}`}`),
      svg("polygon", { points: points(shape) }),
      svg("polyline", { points: points([shape[1], nose, shape[0]]), class: "nose" }),
      v.speed > 0.5 ? line(nose, tip, "speed") : null,
      v.part === "danger" && svg("path", { d: `M${v.x} ${-v.y - 4.6}l4.6 4.6l-4.6 4.6l-4.6 -4.6z`, class: "ring" })));
  }
  const when = (s) => (s == null ? "stands" : s < 0 ? "past" : number(s, 1, "s"));
  const both = (c) => `${ego.id} ${when(c.ego)}, ${c.with} ${when(c.other)}`;
  for (const c of sees.conflicts) {
    picture.append(svg("path", { d: `M${c.x - 1.3} ${-c.y - 1.3}l2.6 2.6m0 -2.6l-2.6 2.6`, class: "conflict" },
      svg("title", {}, `paths cross: ${both(c)}`)));
  }
  for (const m of messages) {
    const sender = world.vehicles.find((v) => v.id === m.from);
    if (!sender) continue;
    picture.append(line([sender.x, sender.y], [ego.x, ego.y], `message ${m.on_time ? "ontime" : m.delivered ? "late" : "lost"}`));
  }
  for (const v of world.vehicles.filter(within)) {
    const fate = messages.find((m) => m.from === v.id);
    const arrived = !fate ? "" : fate.delivered ? `, ${number(fate.arrival_ms, 0, "ms")}${fate.on_time ? "" : " late"}` : ", lost";
    const said = fate?.attacker ? `${arrived}, attacks` : arrived;
    const action = agents.find((each) => each.id === v.id)?.decision.action;
    const kind = NARROW.includes(v.kind) ? ` ${v.kind}` : "";
    label(`${v.id}${kind} ${number(v.speed, 0, "m/s")}${action ? ` ${action}` : ""}${v.crashed ? ", crashed" : ""}${said}`, v.x, -v.y, v.width / 2 + 1, v.part);
  }
  for (const c of sees.conflicts) label(both(c), c.x, -c.y, 1.6, "crossing");
  const bar = side > 100 ? 20 : 10, [left, foot] = [west + side * 0.03, view[3] - side * 0.03];
  picture.append(
    svg("path", { d: `M${left} ${foot - side * 0.01}v${side * 0.01}h${bar}v${-side * 0.01}`, class: "scale" }),
    svg("text", { x: left + bar / 2, y: foot - size * 0.9, "font-size": size, class: "label" }, `${bar} m`),
  );
  return [picture, told];
}

const NARROW = ["bicycle", "motorcycle", "pedestrian"];
const KEY = "Purple: the ego. Light: helpers. Pink with a ring: the dangerous vehicle. Dashed, and all that is shaded: hidden from the "
  + "viewer. Arrow: the way in 1 s. ×: where paths cross, and when each vehicle is there. Thick lines: replies to the ego.";
const KEY_OF_NARROW = " Bicycles, motorcycles and pedestrians are named; all are drawn in true size.";
const keyOf = (world) => KEY + (world.vehicles.some((v) => NARROW.includes(v.kind)) ? KEY_OF_NARROW : "");
const KEY_OF_AGENTS = " Purple is who decides here; at each agent is what it decides in this step. Click another to see its decision.";
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
