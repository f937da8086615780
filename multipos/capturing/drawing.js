// What the pages of `capture` and `page` draw alike: elements, numbers, and the sphere of positions.

const SVG = "http://www.w3.org/2000/svg";
const SIZE = 400; // of the sphere's own coordinates
const RADIUS = 172;

/** Return the element with an id. */
export const $ = id => document.getElementById(id);

/** Return a new element with a text or children, and a class. */
export function element(name, content = "", className = "") {
  const made = document.createElement(name);
  if (Array.isArray(content)) made.append(...content);
  else made.textContent = content;
  if (className) made.className = className;
  return made;
}

/** Return a cell of a table; numbers stand at its right. */
export const cell = (text, isNumber) => element("td", text, isNumber ? "n" : "");

/** Return the decimals that two digits of an uncertainty have. */
export function decimals(U) {
  if (!(U > 0) || !isFinite(U)) return 6;
  return Math.min(12, Math.max(0, 1 - Math.floor(Math.log10(U))));
}

/** Return a row of the table of parameters, whose name and numbers programs may read. */
export function parameterRow(parameter, cells) {
  const name = element("th", parameter.name), row = element("tr", [name, ...cells]);
  name.scope = "row";
  name.title = parameter.label || "";
  Object.assign(row.dataset, { name: parameter.name, value: parameter.value, expanded: parameter.U });
  return row;
}

/** Return the class of a residual: within its U, beyond it, or beyond twice that. */
export function shade(residual, u) {
  const ratio = u ? Math.abs(residual) / (2 * u) : 0;
  return ratio <= 1 ? "good" : ratio <= 2 ? "warn" : "bad";
}

/** Return the legend of classes of marks, each with its words. */
export function legend(entries) {
  return entries.map(([kind, text]) => element("span", [element("i", "", `key ${kind}`), text], "legend"));
}

/** Return the product of two vectors: scalar, and across both. */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
export const unit = a => a.map(x => x / (Math.hypot(...a) || 1));

function drawn(name, attributes, children = []) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

/**
 * Draw directions on a sphere in an svg element, turned by pointer and arrow keys.
 *
 * `show(marks, way)` takes marks {direction, kind, label, title} and an optional way from one
 * direction to another; `look(direction)` turns it to the eye unless somebody holds it.
 */
export function makeSphere(svg) {
  // The rows turn case axes to the screen: x right, y up, z to the eye.
  let view = [[0.8, -0.6, 0], [0.25, 0.33, 0.91], [-0.546, -0.728, 0.414]];
  let shown = [[], null], held = false, from = null;
  svg.setAttribute("viewBox", `0 0 ${SIZE} ${SIZE}`);
  const see = p => view.map(row => dot(row, p));
  const at = p => {
    const [x, y, z] = see(p);
    return [SIZE / 2 + RADIUS * x, SIZE / 2 - RADIUS * y, z];
  };

  function turn(right, up) {
    const rotate = (a, b, angle) => {
      const [c, s] = [Math.cos(angle), Math.sin(angle)];
      const [p, q] = [view[a], view[b]];
      view[a] = p.map((x, i) => c * x + s * q[i]);
      view[b] = q.map((x, i) => c * x - s * p[i]);
    };
    rotate(0, 2, right);
    rotate(1, 2, -up);
    draw();
  }

  /** Return the parts of a curve before and behind the sphere, as paths. */
  function curve(points, kind) {
    const paths = { near: "", far: "" };
    let last = "";
    for (const point of points) {
      const [x, y, z] = at(point), side = z < 0 ? "far" : "near";
      paths[side] += `${side === last ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`;
      last = side;
    }
    return ["far", "near"].map(side => drawn("path", { d: paths[side], class: `${kind} ${side}` }));
  }

  function circle(k) {
    return Array.from({ length: 73 }, (_, i) => {
      const p = [0, 0, 0];
      p[(k + 1) % 3] = Math.cos(i * Math.PI / 36);
      p[(k + 2) % 3] = Math.sin(i * Math.PI / 36);
      return p;
    });
  }

  function arc([start, end]) {
    const angle = Math.acos(Math.max(-1, Math.min(1, dot(start, end))));
    const side = cross(unit(cross(start, end)), start);
    return Array.from({ length: 41 }, (_, i) => {
      const a = angle * i / 40;
      return [0, 1, 2].map(k => Math.cos(a) * start[k] + Math.sin(a) * side[k]);
    });
  }

  function axisLabel(k, sign) {
    const p = [0, 0, 0];
    p[k] = 1.13 * sign;
    const [x, y, z] = at(p);
    const label = drawn("text", { x, y, class: z < 0 ? "axis far" : "axis" });
    label.textContent = (sign > 0 ? "+" : "−") + "xyz"[k];
    return label;
  }

  function mark({ direction, kind, label = "", title = "" }) {
    const [x, y, z] = at(direction), radius = { next: 13, refused: 5, now: label ? 9 : 7 }[kind] || 9;
    const parts = [drawn("circle", { cx: x, cy: y, r: radius, class: kind })];
    if (label && z >= 0) {
      const beside = kind === "next" ? 18 : 0; // its ring may stand around another mark
      const text = drawn("text", { x: x + beside, y: y - 0.7 * beside });
      text.textContent = label;
      parts.push(text);
    }
    if (title) {
      const said = drawn("title", {});
      said.textContent = title;
      parts.push(said);
    }
    const side = `${z < 0 ? " far" : ""}${kind === "next" ? " next-label" : ""}`;
    return drawn("g", { class: `mark${side}` }, parts);
  }

  function draw() {
    const [marks, way] = shown;
    const depth = each => see(each.direction)[2];
    svg.replaceChildren(
      drawn("circle", { cx: SIZE / 2, cy: SIZE / 2, r: RADIUS, class: "ball" }),
      ...[0, 1, 2].flatMap(k => curve(circle(k), "grid")),
      ...[0, 1, 2].flatMap(k => [axisLabel(k, 1), axisLabel(k, -1)]),
      ...(way ? curve(arc(way), "way") : []),
      ...[...marks].sort((a, b) => depth(a) - depth(b)).map(mark),
    );
  }

  svg.addEventListener("pointerdown", event => {
    from = [event.clientX, event.clientY];
    held = true;
    svg.setPointerCapture(event.pointerId);
  });
  svg.addEventListener("pointermove", event => {
    if (!from) return;
    turn((event.clientX - from[0]) / 150, (event.clientY - from[1]) / 150);
    from = [event.clientX, event.clientY];
  });
  for (const end of ["pointerup", "pointercancel"]) svg.addEventListener(end, () => { from = null; });
  svg.addEventListener("dblclick", () => { held = false; });
  svg.addEventListener("keydown", event => {
    const step = {
      ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1],
    }[event.key];
    if (!step) return;
    held = true;
    turn(...step);
    event.preventDefault();
  });
  return {
    show(marks, way = null) {
      shown = [marks.filter(each => each.direction), way];
      draw();
    },
    look(direction) {
      if (held) return;
      const [x, y, z] = see(unit(direction));
      if (z < 0.8) turn(-0.12 * Math.atan2(x, Math.abs(z) + 0.3), 0.12 * Math.atan2(y, Math.abs(z) + 0.3));
    },
  };
}
