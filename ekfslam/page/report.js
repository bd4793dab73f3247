"use strict";
// Draws maps and plots of a report from the numbers in the page. Names are only ever set as text.

const SVG = "http://www.w3.org/2000/svg";
const MOST_ELLIPSES = 350; // of landmarks in a view
const tip = element("div", { class: "tip", hidden: "" }, document.body);

function element(name, attributes, parent, text) {
  const made = document.createElement(name);
  for (const key in attributes || {}) made.setAttribute(key, attributes[key]);
  if (text !== undefined) made.textContent = text;
  if (parent) parent.appendChild(made);
  return made;
}

function drawn(name, attributes, parent, color) {
  const made = document.createElementNS(SVG, name);
  for (const key in attributes) made.setAttribute(key, attributes[key]);
  if (color) made.style.setProperty("--c", color);
  if (parent) parent.appendChild(made);
  return made;
}

const column = (table, width, j) => Float64Array.from({ length: table.length / width }, (_, i) => table[i * width + j]);

function quantile(values, share) {
  const sorted = Float64Array.from(values).sort();
  return sorted.length ? sorted[Math.round(share * (sorted.length - 1))] : NaN;
}

function ticks(low, high, about) {
  const raw = (high - low) / about, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw) || raw;
  const found = [];
  for (let i = Math.ceil(low / step); i * step <= high + 1e-9 * step; i++) found.push(i * step);
  return found;
}

function logTicks(low, high) {
  const found = [];
  for (let p = Math.floor(Math.log10(low)); 10 ** p <= high; p++)
    for (const m of high / low > 1e3 ? [1] : [1, 2, 5]) if (m * 10 ** p >= low && m * 10 ** p <= high) found.push(m * 10 ** p);
  return found;
}

/** A number with about three digits, without an exponent where it can be. */
function short(value) {
  const size = Math.abs(value);
  if (size === 0) return "0";
  if (size >= 1e5 || size < 1e-4) return value.toExponential(1);
  return String(+value.toPrecision(size >= 100 ? Math.ceil(Math.log10(size)) : 3)).replace("-", "−");
}

function showTip(event, text) {
  tip.textContent = text;
  tip.hidden = false;
  const box = tip.getBoundingClientRect();
  tip.style.left = Math.max(4, Math.min(event.clientX + 14, innerWidth - box.width - 4)) + "px";
  tip.style.top = (event.clientY + box.height + 24 > innerHeight ? event.clientY - box.height - 12 : event.clientY + 14) + "px";
}

function nearest(sorted, x) {
  let low = 0, high = sorted.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (sorted[middle] < x) low = middle; else high = middle;
  }
  return Math.abs(sorted[low] - x) <= Math.abs(sorted[high] - x) ? low : high;
}

function path(xs, ys, to) {
  let text = "", down = false;
  for (let i = 0; i < xs.length; i++) {
    if (!Number.isFinite(ys[i])) { down = false; continue; }
    const [x, y] = to(xs[i], ys[i]);
    text += (down ? "L" : "M") + x.toFixed(1) + " " + y.toFixed(1);
    down = true;
  }
  return text;
}

/** Add a figure with a caption to `parent`; `draw` fills its room, again if the width changes. */
function figure(parent, title, words, draw) {
  const made = element("figure", { class: "plot" }, parent);
  const caption = element("figcaption", {}, made);
  element("b", {}, caption, title);
  element("span", {}, caption, words || "");
  const room = element("div", {}, made);
  let width = 0;
  const fill = () => {
    const now = Math.floor(room.clientWidth);
    if (now && now !== width) draw(room, (width = now));
  };
  fill();
  new ResizeObserver(() => requestAnimationFrame(fill)).observe(room);
  return made;
}

/** A plot of the table of series, `plotted` in content.py: curves with bounds and levels, colours of recording `g`. */
function plot(parent, spec, g, dashes, onTime) {
  const of = (j) => (j === null ? "var(--ink)" : colorOf(g, j));
  figure(parent, spec.title, spec.words, (room, width) => {
    room.replaceChildren();
    const height = spec.height || 190, left = 50, bottom = 24, top = 6, right = 8;
    const svg = drawn("svg", { viewBox: `0 0 ${width} ${height}`, height, role: "img", "aria-label": spec.title }, room);
    let x0 = Infinity, x1 = -Infinity, y0 = Math.min(...spec.levels, Infinity), y1 = Math.max(...spec.levels, -Infinity);
    for (const { x, y, low, high } of spec.curves)
      for (const values of [y, low, high]) for (let i = 0; values && i < x.length; i++) {
        if (!Number.isFinite(values[i]) || (spec.log && values[i] <= 0)) continue;
        x0 = Math.min(x0, x[i]); x1 = Math.max(x1, x[i]); y0 = Math.min(y0, values[i]); y1 = Math.max(y1, values[i]);
      }
    if (!(x1 > x0)) { x0 = (x0 === Infinity ? 0 : x0) - 0.5; x1 = x0 + 1; }
    if (spec.log) { y0 = Math.max(y0, y1 * 1e-5) / 1.15; y1 *= 1.15; }
    else { const margin = 0.06 * (y1 - y0) || 1; y0 -= margin; y1 += margin; }
    const f = spec.log ? Math.log : (v) => v;
    const X = (x) => left + ((x - x0) / (x1 - x0)) * (width - left - right);
    const Y = (y) => top + ((f(y1) - f(spec.log ? Math.max(y, y0) : y)) / (f(y1) - f(y0))) * (height - top - bottom);
    const to = (x, y) => [X(x), Y(y)];
    for (const y of spec.log ? logTicks(y0, y1) : ticks(y0, y1, 4)) {
      drawn("line", { class: "rule", x1: left, x2: width - right, y1: Y(y), y2: Y(y) }, svg);
      drawn("text", { class: "axis", x: left - 7, y: Y(y) + 4, "text-anchor": "end" }, svg).textContent = short(y);
    }
    for (const x of ticks(x0, x1, Math.max(3, width / 110)).filter((x) => X(x) < width - right - 8 * spec.xLabel.length))
      drawn("text", { class: "axis", x: X(x), y: height - 7, "text-anchor": "middle" }, svg).textContent = short(x);
    drawn("text", { class: "axis", x: width - right, y: height - 7, "text-anchor": "end" }, svg).textContent = spec.xLabel;
    for (const { x, low, high, band } of spec.curves.filter((c) => c.low)) {
      const up = path(x, high, to), down = path([...x].reverse(), [...low].reverse(), to).replace("M", "L");
      if (up) drawn("path", { class: band === null ? "region" : "fill", d: up + down + "Z" }, svg, of(band));
    }
    for (const level of spec.levels) drawn("line", { class: "zero", x1: left, x2: width - right, y1: Y(level), y2: Y(level) }, svg);
    for (const { x, y, kind, run } of spec.curves) {
      if (kind === "dots") {
        const d = Array.from(x, (v, i) => `M${X(v).toFixed(1)} ${Y(y[i]).toFixed(1)}h.01`).join("");
        drawn("path", { class: "dots", d, "stroke-width": 2.6 }, svg, of(run));
      } else drawn("path", { class: `line ${kind}`, d: path(x, y, to), "stroke-dasharray": kind || run === null ? "" : dashes[run] }, svg, of(run));
    }
    hover(svg, spec, X, width, height, left, right, bottom, spec.xUnit === "s" ? onTime : () => {});
  });
}

function hover(svg, spec, X, width, height, left, right, bottom, onTime) {
  const cursor = drawn("line", { class: "cursor", y1: 0, y2: height - bottom, visibility: "hidden" }, svg);
  const end = () => { tip.hidden = true; cursor.setAttribute("visibility", "hidden"); onTime(null); };
  svg.addEventListener("pointerleave", end);
  svg.addEventListener("pointermove", (event) => {
    const at = event.clientX - svg.getBoundingClientRect().left, share = (at - left) / (width - left - right), lines = [];
    let first = null;
    for (const { x, y, low, high, name } of share < 0 || share > 1 ? [] : spec.curves.filter((c) => c.x.length)) {
      const last = x[x.length - 1];
      const i = nearest(x, x[0] + ((at - X(x[0])) / (X(last) - X(x[0]) || 1)) * (last - x[0]));
      first = first === null ? x[i] : first;
      lines.push(`${name}: ${short(y[i])} ${spec.unit}` + (low ? ` (${short(low[i])} to ${short(high[i])})` : ""));
    }
    if (first === null) return end();
    cursor.setAttribute("visibility", "visible");
    cursor.setAttribute("x1", X(first)); cursor.setAttribute("x2", X(first));
    onTime(first);
    showTip(event, `${short(first)} ${spec.xUnit}\n${lines.join("\n")}`);
  });
}

const colorOf = (g, j) => `var(--run-${g}-${j})`;

function chip(parent, text, checked, change, color, dash) {
  const label = element("label", { class: "chip" }, parent);
  const box = element("input", { type: "checkbox" }, label);
  box.checked = checked;
  box.addEventListener("change", () => change(box.checked));
  if (color) {
    const sample = drawn("svg", { viewBox: "0 0 22 10" }, label);
    drawn("path", { class: "line", d: "M1 5h20", "stroke-dasharray": dash || "" }, sample, color).style.strokeWidth = "2.4";
  }
  element("span", {}, label, text);
}

/** Add buttons, exactly one of them pressed. */
function choose(parent, heading, names, chosen, change) {
  const row = element("div", { class: "choices" }, parent);
  element("span", {}, row, heading);
  const buttons = names.map((name, i) => {
    const button = element("button", { type: "button", "aria-pressed": String(i === chosen) }, row, name);
    button.addEventListener("click", () => {
      buttons.forEach((other, k) => other.setAttribute("aria-pressed", String(k === i)));
      change(i);
    });
    return button;
  });
}

/** Half axes of one sigma and direction of the ellipse of a covariance ((a, b), (b, c)). */
function ellipse(a, b, c) {
  const middle = (a + c) / 2, root = Math.hypot((a - c) / 2, b);
  return [Math.sqrt(Math.max(middle + root, 0)), Math.sqrt(Math.max(middle - root, 0)), Math.atan2(2 * b, a - c) / 2];
}

const COV = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]; // where an entry of a covariance stands in its packed row
const VIEWS = [["from above", 0, 1], ["from the side, x", 0, 2], ["from the side, y", 1, 2]];

/** The map of a recording: layers, views from three sides, zoom. */
class Track {
  constructor(parent, recording, g) {
    Object.assign(this, { recording, g, view: 0, scale: 1, centre: [0, 0], stretch: 1, follow: true });
    const withMap = recording.runs.flatMap((run, j) => (run.landmarks ? [j] : []));
    const best = withMap.find((j) => recording.runs[j].mode === "full" && recording.runs[j].shown);
    this.mapper = best === undefined ? (withMap.length ? withMap[withMap.length - 1] : -1) : best;
    this.shown = { truth: true, landmarks: true, ellipses: true, poses: true, yaw: false, known: false };
    recording.runs.forEach((run, j) => (this.shown[j] = run.shown));
    choose(parent, "View", VIEWS.map((v) => v[0]), 0, (i) => { this.view = i; this.fit(); this.draw(); });
    if (withMap.length > 1)
      choose(parent, "Landmarks of", withMap.map((j) => recording.runs[j].label), withMap.indexOf(this.mapper), (i) => {
        this.mapper = withMap[i]; this.classes = null; this.draw();
      });
    this.layers(element("div", { class: "choices" }, parent));
    this.frame = element("div", { class: "map", tabindex: "0", "aria-label": "map" });
    this.svg = drawn("svg", { role: "img" }, this.frame);
    this.words = element("p", { class: "hint" });
    const box = figure(parent, "Map", "metres, world frame", (room, width) => {
      this.width = width; this.height = Math.round(Math.min(Math.max(0.62 * width, 330), 620));
      room.replaceChildren(this.frame, this.words);
      if (this.follow) this.fit();
      this.paint();
    });
    box.setAttribute("aria-label", "map");
    const zoom = element("div", { class: "zoom" }, this.frame);
    for (const [sign, name, factor] of [["+", "zoom in", 1.6], ["−", "zoom out", 1 / 1.6], ["⤢", "show all", 0]]) {
      const button = element("button", { type: "button", "aria-label": name, title: name }, zoom, sign);
      button.addEventListener("click", () => (factor ? this.zoom(factor, this.width / 2, this.height / 2) : (this.fit(), this.draw())));
    }
    this.listen();
  }

  layers(row) {
    element("span", {}, row, "Layers");
    const toggle = (key, text, color, dash) => chip(row, text, this.shown[key], (on) => { this.shown[key] = on; this.draw(); }, color, dash);
    if (this.recording.truth) toggle("truth", "truth", "var(--ink)");
    this.recording.runs.forEach((run, j) => toggle(j, run.label, colorOf(this.g, j), run.dash));
    if (this.mapper >= 0) { toggle("landmarks", "landmarks", this.recording.landmarkColor); toggle("ellipses", "their ellipses"); }
    if (this.recording.truth && this.recording.truth.landmarks.length) toggle("known", "true landmarks", "var(--good)", "1 4");
    toggle("poses", "ellipses of poses");
    toggle("yaw", "heading");
  }

  get axes() { return VIEWS[this.view].slice(1); }

  fit() {
    const [a, b] = this.axes;
    let low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    const widen = (xs, ys) => {
      for (let i = 0; i < xs.length; i++) {
        low = [Math.min(low[0], xs[i]), Math.min(low[1], ys[i])];
        high = [Math.max(high[0], xs[i]), Math.max(high[1], ys[i])];
      }
    };
    this.recording.runs.forEach((run, j) => this.shown[j] && widen(column(run.xyz, 3, a), column(run.xyz, 3, b)));
    if (this.recording.truth) widen(column(this.recording.truth.xyz, 3, a), column(this.recording.truth.xyz, 3, b));
    if (this.mapper >= 0 && this.shown.landmarks) {
      const m = this.recording.runs[this.mapper].landmarks.xyz, xs = column(m, 3, a), ys = column(m, 3, b);
      widen([quantile(xs, 0.02), quantile(xs, 0.98)], [quantile(ys, 0.02), quantile(ys, 0.98)]);
    }
    if (!(high[0] >= low[0])) { low = [-1, -1]; high = [1, 1]; }
    const size = [Math.max(high[0] - low[0], 1e-2), Math.max(high[1] - low[1], 1e-2)];
    this.scale = 0.88 * this.width / size[0];
    if (this.view === 0) this.scale = Math.min(this.scale, 0.88 * this.height / size[1]);
    const stretch = (0.6 * this.height) / (this.scale * size[1]); // heights hardly show at the scale of a drive
    this.stretch = this.view === 0 ? 1 : stretch < 1 ? stretch : [50, 20, 10, 5, 2, 1].find((s) => s <= stretch) || 1;
    this.centre = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2];
    this.follow = true;
  }

  X(x) { return this.width / 2 + (x - this.centre[0]) * this.scale; }
  Y(y) { return this.height / 2 - (y - this.centre[1]) * this.scale * this.stretch; }

  zoom(factor, px, py) {
    const x = this.centre[0] + (px - this.width / 2) / this.scale;
    const y = this.centre[1] - (py - this.height / 2) / (this.scale * this.stretch);
    this.scale = Math.min(Math.max(this.scale * factor, 1e-3), 1e6);
    this.centre = [x - (px - this.width / 2) / this.scale, y + (py - this.height / 2) / (this.scale * this.stretch)];
    this.follow = false;
    this.draw();
  }

  draw() {
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => { this.waiting = 0; if (this.width) this.paint(); });
  }

  paint() {
    const { svg, width, height, recording } = this, [a, b] = this.axes;
    svg.replaceChildren();
    svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    svg.setAttribute("height", height);
    this.rules();
    const to = (x, y) => [this.X(x), this.Y(y)];
    this.said = [];
    if (this.mapper >= 0) this.landmarks();
    if (this.shown.known && recording.truth) {
      const m = recording.truth.landmarks;
      drawn("path", { class: "dots", d: this.dots(column(m, 3, a), column(m, 3, b)).join(""), "stroke-width": 2 }, svg, "var(--good)");
    }
    if (this.shown.truth && recording.truth)
      drawn("path", { class: "line truth", d: path(column(recording.truth.xyz, 3, a), column(recording.truth.xyz, 3, b), to) }, svg);
    recording.runs.forEach((run, j) => {
      if (!this.shown[j]) return;
      const color = colorOf(this.g, j), xs = column(run.xyz, 3, a), ys = column(run.xyz, 3, b);
      drawn("path", { class: "line", d: path(xs, ys, to), "stroke-dasharray": run.dash }, svg, color);
      this.marks(run, color);
      const n = xs.length - 1;
      drawn("circle", { class: "mark", cx: this.X(xs[n]), cy: this.Y(ys[n]), r: 5 }, svg, color);
      if (j === recording.runs.findIndex((_, k) => this.shown[k]))
        drawn("circle", { class: "white", cx: this.X(xs[0]), cy: this.Y(ys[0]), r: 5 }, svg);
    });
    this.pins = drawn("g", {}, svg);
    const heights = this.stretch === 1 ? "" : ` Heights are drawn ${short(this.stretch)} times as large.`;
    this.words.textContent = `White: start; filled: end. ${this.said.join(" ")}${heights} Click the map, then zoom with wheel or fingers; drag to move.`;
  }

  rules() {
    const { svg, width, height } = this, w = width / 2 / this.scale, h = height / 2 / (this.scale * this.stretch);
    for (const x of ticks(this.centre[0] - w, this.centre[0] + w, Math.max(3, width / 120))) {
      drawn("line", { class: "rule", x1: this.X(x), x2: this.X(x), y1: 0, y2: height }, svg);
      drawn("text", { class: "axis", x: this.X(x) + 3, y: height - 5 }, svg).textContent = short(x);
    }
    for (const y of ticks(this.centre[1] - h, this.centre[1] + h, Math.max(3, height / 90))) {
      drawn("line", { class: "rule", x1: 0, x2: width, y1: this.Y(y), y2: this.Y(y) }, svg);
      if (this.Y(y) < height - 22) drawn("text", { class: "axis", x: 4, y: this.Y(y) - 4 }, svg).textContent = short(y);
    }
  }

  dots(xs, ys) {
    const found = [];
    for (let i = 0; i < xs.length; i++) {
      const x = this.X(xs[i]), y = this.Y(ys[i]);
      found.push(x < -9 || x > this.width + 9 || y < -9 || y > this.height + 9 ? "" : `M${x.toFixed(1)} ${y.toFixed(1)}h.01`);
    }
    return found;
  }

  landmarks() {
    const { svg, recording } = this, map = recording.runs[this.mapper].landmarks, [a, b] = this.axes;
    const xs = column(map.xyz, 3, a), ys = column(map.xyz, 3, b), color = recording.landmarkColor;
    const dots = this.dots(xs, ys), inside = [];
    dots.forEach((d, i) => d && inside.push(i));
    const outside = xs.length - inside.length;
    const all = `${xs.length} landmarks of ${recording.runs[this.mapper].label}` + (outside ? `, ${outside} outside the view.` : ".");
    if (this.shown.landmarks) {
      // The more there are in the view, the smaller and fainter, or a dense map would be one blot.
      const size = Math.min(Math.max(90 / Math.sqrt(inside.length + 1), 1.5), 4.5);
      const layer = drawn("path", { class: "dots", d: dots.join(""), "stroke-width": size.toFixed(2) }, svg, color);
      layer.style.opacity = Math.min(Math.max(26 / Math.sqrt(inside.length + 1), 0.4), 0.9);
      this.said.push(all);
    }
    if (!this.shown.ellipses) return;
    const stride = Math.ceil(inside.length / MOST_ELLIPSES) || 1, some = inside.filter((_, k) => k % stride === 0);
    const [text, large] = this.ellipses(map.xyz, map.cov, some, 0.15);
    const layer = drawn("path", { class: "line thin", d: text }, svg, color);
    layer.style.opacity = Math.min(Math.max(12 / Math.sqrt(some.length + 1), 0.35), 0.9);
    this.said.push(
      `Ellipses hold ${recording.sigmas} sigma, 86 % of a Gaussian in this plane` +
      (stride > 1 ? `; one in ${stride} landmarks shows its own, zoom in for all` : "") +
      (large ? `; ${large} too large to be drawn.` : ".")
    );
  }

  /** Ellipses of rows of points as one path, those longer than a share of the view left out and counted. */
  ellipses(xyz, cov, rows, share) {
    const [a, b] = this.axes, kx = this.scale, ky = this.scale * this.stretch, limit = share * Math.hypot(this.width, this.height), { sigmas } = this.recording;
    let text = "", large = 0;
    for (const i of rows) {
      const at = (p, q) => cov[6 * i + COV[p][q]];
      const [half, other, angle] = ellipse(kx * kx * at(a, a), -kx * ky * at(a, b), ky * ky * at(b, b));
      const long = sigmas * half, thin = sigmas * other;
      if (long > limit) { large++; continue; }
      const x = this.X(xyz[3 * i + a]), y = this.Y(xyz[3 * i + b]), dx = long * Math.cos(angle), dy = long * Math.sin(angle);
      const arc = `A${long.toFixed(2)} ${thin.toFixed(2)} ${(angle * 180 / Math.PI).toFixed(1)} 1 0 `;
      if (long > 0.6) text += `M${(x - dx).toFixed(2)} ${(y - dy).toFixed(2)}${arc}${(x + dx).toFixed(2)} ${(y + dy).toFixed(2)}${arc}${(x - dx).toFixed(2)} ${(y - dy).toFixed(2)}`;
    }
    return [text, large];
  }

  marks(run, color) {
    const { xyz, cov, forward } = run.marks, rows = Array.from({ length: xyz.length / 3 }, (_, i) => i), [a, b] = this.axes;
    if (this.shown.poses) drawn("path", { class: "line thin", d: this.ellipses(xyz, cov, rows, 0.5)[0] }, this.svg, color);
    if (!this.shown.yaw) return;
    let text = "";
    for (const i of rows) {
      const x = this.X(xyz[3 * i + a]), y = this.Y(xyz[3 * i + b]);
      const fx = forward[3 * i + a], fy = -forward[3 * i + b] * this.stretch, size = Math.hypot(fx, fy) || 1;
      const ex = x + (22 * fx) / size, ey = y + (22 * fy) / size, angle = Math.atan2(fy, fx);
      text += `M${x.toFixed(1)} ${y.toFixed(1)}L${ex.toFixed(1)} ${ey.toFixed(1)}`;
      for (const side of [2.6, -2.6]) text += `M${ex.toFixed(1)} ${ey.toFixed(1)}L${(ex + 7 * Math.cos(angle + side)).toFixed(1)} ${(ey + 7 * Math.sin(angle + side)).toFixed(1)}`;
    }
    drawn("path", { class: "line", d: text }, this.svg, color);
  }

  /** Pins where the shown runs are at a time; null takes them away. */
  pin(time) {
    if (!this.pins) return;
    this.pins.replaceChildren();
    if (time === null) return;
    const i = nearest(this.recording.time, time), [a, b] = this.axes;
    this.recording.runs.forEach((run, j) => {
      if (this.shown[j]) drawn("circle", { class: "mark", cx: this.X(run.xyz[3 * i + a]), cy: this.Y(run.xyz[3 * i + b]), r: 7 }, this.pins, colorOf(this.g, j));
    });
  }

  listen() {
    const { svg, frame } = this, pointers = new Map();
    const at = (event) => { const box = svg.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
    frame.addEventListener("focusin", () => frame.classList.add("active"));
    frame.addEventListener("focusout", () => frame.classList.remove("active"));
    svg.addEventListener("wheel", (event) => {
      if (!frame.classList.contains("active") && !event.ctrlKey) return;
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY / 400), ...at(event));
    }, { passive: false });
    svg.addEventListener("pointerdown", (event) => { pointers.set(event.pointerId, at(event)); svg.setPointerCapture(event.pointerId); frame.focus({ preventScroll: true }); });
    const up = (event) => pointers.delete(event.pointerId);
    svg.addEventListener("pointerup", up);
    svg.addEventListener("pointercancel", up);
    svg.addEventListener("pointerleave", () => (tip.hidden = true));
    svg.addEventListener("pointermove", (event) => {
      const here = at(event), before = pointers.get(event.pointerId);
      if (!before) return this.tell(event, here);
      const other = [...pointers].find(([id]) => id !== event.pointerId);
      pointers.set(event.pointerId, here);
      if (other) {
        const distance = (p) => Math.hypot(p[0] - other[1][0], p[1] - other[1][1]) || 1;
        return this.zoom(distance(here) / distance(before), (here[0] + other[1][0]) / 2, (here[1] + other[1][1]) / 2);
      }
      this.centre = [this.centre[0] - (here[0] - before[0]) / this.scale, this.centre[1] + (here[1] - before[1]) / (this.scale * this.stretch)];
      this.follow = false;
      this.draw();
    });
    svg.addEventListener("dblclick", (event) => this.zoom(2, ...at(event)));
    frame.addEventListener("keydown", (event) => {
      const factor = { "+": 1.4, "=": 1.4, "-": 1 / 1.4 }[event.key];
      if (factor) this.zoom(factor, this.width / 2, this.height / 2);
    });
  }

  /** What lies under the pointer. */
  tell(event, [px, py]) {
    const [a, b] = this.axes;
    let best = 14 ** 2, text = null;
    const look = (xyz, say) => {
      for (let i = 0; i < xyz.length / 3; i++) {
        const d = (this.X(xyz[3 * i + a]) - px) ** 2 + (this.Y(xyz[3 * i + b]) - py) ** 2;
        if (d < best) { best = d; text = () => say(i); }
      }
    };
    const place = (xyz, std) => [0, 1, 2].map((k) => `${"xyz"[k]} ${short(xyz(k))} ± ${short(std(k))} m`).join("\n");
    this.recording.runs.forEach((run, j) => {
      if (this.shown[j]) look(run.xyz, (i) => `${run.label}, ${short(this.recording.time[i])} s\n` + place((k) => run.xyz[3 * i + k], (k) => run.std[3 * i + k]));
    });
    if (this.mapper >= 0 && this.shown.landmarks) {
      const map = this.recording.runs[this.mapper].landmarks;
      look(map.xyz, (i) => `landmark ${map.id[i]}, ${map.count[i]} observations\n` + place((k) => map.xyz[3 * i + k], (k) => Math.sqrt(Math.max(map.cov[6 * i + COV[k][k]], 0))));
    }
    if (text) showTip(event, text()); else tip.hidden = true;
  }
}

function ofRun(room, run, g, dashes, onTime) {
  room.replaceChildren();
  element("p", { class: "hint" }, room, run.words);
  const six = element("div", { class: "grid3" }, room), two = element("div", { class: "grid2" }, room);
  for (const spec of [...run.errors, ...run.inertial]) plot(six, { height: 150, ...spec }, g, dashes, onTime);
  for (const spec of run.consistency) plot(two, spec, g, dashes, onTime);
  if (!run.consistency.length) element("p", { class: "hint" }, two, "This run has no innovations.");
}

const unpacked = (key, value) => (value && value.f32 !== undefined
  ? new Float32Array(Uint8Array.from(atob(value.f32), (c) => c.charCodeAt(0)).buffer) : value);

JSON.parse(document.getElementById("data").textContent, unpacked).forEach((recording, g) => {
  const parent = document.querySelector(`.plots[data-recording="${g}"]`), dashes = recording.runs.map((run) => run.dash);
  const track = new Track(parent, recording, g), onTime = (time) => track.pin(time);
  element("h3", {}, parent, "Height and errors");
  const row = element("div", { class: "grid2" }, parent);
  for (const spec of recording.plots) plot(row, spec, g, dashes, onTime);
  element("h3", {}, parent, "Consistency");
  const room = element("div"), show = (j) => ofRun(room, recording.runs[j], g, dashes, onTime);
  const first = Math.max(recording.runs.findIndex((run) => run.mode === "full"), 0);
  if (recording.runs.length > 1) choose(parent, "Run", recording.runs.map((run) => run.label), first, show);
  parent.appendChild(room);
  show(first);
});
