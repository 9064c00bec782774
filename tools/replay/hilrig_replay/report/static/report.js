"use strict";
// Interactive part of a report: the arm from above and from the side, plots and events, linked by one time.
// The values are in <script type="application/json"> (timeline.py). All texts are inserted as text, never as HTML.

const TRAIL_S = 2;
const SPEEDS = [0.25, 0.5, 1, 2, 5, 10];
const AXIS_PX = 56;
const KEY_STEPS = {ArrowLeft: -1, ArrowRight: 1, PageUp: -50, PageDown: 50};

function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

function bytes(text) {
  return Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
}

function floats(text) {
  return new Float32Array(bytes(text).buffer);
}

// Index of the last value that is not larger than `wanted`; 0: all are larger.
function indexAt(values, wanted) {
  let low = 0, high = values.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (values[middle] <= wanted) low = middle + 1;
    else high = middle;
  }
  return Math.max(low - 1, 0);
}

// uPlot draws a gap at null only.
const withGaps = (values) => Array.from(values, (value) => (Number.isNaN(value) ? null : value));
const radians = (degrees) => (degrees * Math.PI) / 180;
const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
// Without the sign of a negative value that is rounded to zero.
const fixed = (value, digits) => (value === null || Number.isNaN(value) ? "–" : value.toFixed(digits).replace(/^-(?=0\.?0*$)/, ""));

// ---- views of the arm

class View {
  // `project` maps a point x, y, z (mm) to the plane of the view; `box` is its extent: left, right, bottom, top.
  constructor(title, project, box) {
    this.project = project;
    this.box = box;
    this.canvas = element("canvas", {role: "img", "aria-label": title});
    this.figure = element("figure", {}, this.canvas, element("figcaption", {}, title));
  }

  begin() {
    const ratio = devicePixelRatio || 1, width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(height * ratio);
    }
    const [left, right, bottom, top] = this.box, pen = this.canvas.getContext("2d");
    this.scale = Math.min(width / (right - left), height / (top - bottom));
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.clearRect(0, 0, this.canvas.width, this.canvas.height);
    // y up, millimeters, centered.
    const scale = this.scale * ratio;
    pen.setTransform(scale, 0, 0, -scale, this.canvas.width / 2 - (scale * (left + right)) / 2,
      this.canvas.height / 2 + (scale * (bottom + top)) / 2);
    pen.lineCap = pen.lineJoin = "round";
    this.pen = pen;
    return pen;
  }

  line(points, stroke, pixels) {
    if (points.length < 2) return;
    this.pen.beginPath();
    points.forEach((point, number) => this.pen[number ? "lineTo" : "moveTo"](...this.project(...point)));
    this.pen.strokeStyle = stroke;
    this.pen.lineWidth = pixels / this.scale;
    this.pen.stroke();
  }

  dot(point, fill, pixels) {
    this.pen.beginPath();
    this.pen.arc(...this.project(...point), pixels / this.scale, 0, 2 * Math.PI);
    this.pen.fillStyle = fill;
    this.pen.fill();
  }
}

class Arm {
  constructor(run) {
    this.run = run;
    const scene = run.scene, span = 1.1 * scene.span, low = Math.min(scene.table, scene.bottom) - 40;
    this.above = new View("from above", (x, y) => [x, y], [-span, span, -span, span]);
    this.side = new View("from the side (x, z)", (x, y, z) => [x, z], [-span, span, low, scene.shoulder + 130]);
    this.figures = [this.above.figure, this.side.figure];
    this.reach = new Path2D(scene.reach);
  }

  draw(at, row) {
    const run = this.run, {scene, flags} = run, [l2, l3] = scene.links;
    const joints = run.position.map((values) => values[row]);
    const [theta1, theta12] = [radians(joints[0]), radians(joints[0] + joints[1])];
    const elbow = [l2 * Math.cos(theta1), l2 * Math.sin(theta1), scene.shoulder];
    const wrist = [elbow[0] + l3 * Math.cos(theta12), elbow[1] + l3 * Math.sin(theta12), scene.shoulder];
    const tool = [wrist[0], wrist[1], scene.shoulder - joints[2]];
    const parts = scene.parts.map((part, number) => ({...part, pose: run.poseOf(number, at)}));
    for (const view of [this.above, this.side]) this.drawView(view, at, row, {elbow, wrist, tool, parts, flags});
  }

  drawView(view, at, row, {elbow, wrist, tool, parts, flags}) {
    const {scene, targets, state} = this.run, pen = view.begin(), top = view === this.above;
    const faint = color("--faint"), ink = color("--text"), goal = color("--good");
    if (top) {
      pen.strokeStyle = faint;
      pen.lineWidth = 1 / view.scale;
      pen.stroke(this.reach);
    } else {
      view.line([[view.box[0], 0, scene.table], [view.box[1], 0, scene.table]], faint, 1);
    }
    for (const tray of scene.trays) this.drawBox(view, tray, [...tray.at.slice(0, 2), tray.z[0] + tray.z[1] / 2, tray.at[2]], 0.45);
    if (top) for (const tray of scene.trays) for (const [x, y] of tray.places) view.dot([x, y, 0], faint, 2);
    for (const part of parts) this.drawBox(view, part, part.pose, 1);
    pen.globalAlpha = 0.6;
    view.line(targets.path, goal, 3);
    pen.globalAlpha = 1;
    for (const pose of targets.poses) view.dot(pose.at, goal, 4);
    view.line(this.run.trail(at, row), color("--accent"), 1);
    view.line([[0, 0, Math.min(scene.table, 0)], [0, 0, scene.shoulder]], faint, top ? 1 : 6);
    view.line([[0, 0, scene.shoulder], elbow, wrist], ink, 5);
    if (!top) view.line([wrist, tool], ink, 2);
    view.dot(elbow, ink, 4);
    view.dot([0, 0, scene.shoulder], ink, 5);
    const active = state[row] & flags.holds ? goal : state[row] & flags.magnet ? color("--warn") : ink;
    view.dot(tool, active, 5);
    if (state[row] & flags.stop) {
      pen.beginPath();
      pen.arc(...view.project(...tool), 9 / view.scale, 0, 2 * Math.PI);
      pen.strokeStyle = color("--bad");
      pen.lineWidth = 2 / view.scale;
      pen.stroke();
    }
  }

  drawBox(view, thing, [x, y, z, yaw], alpha) {
    const pen = view.pen, [length, width] = thing.size, height = thing.z[1];
    pen.save();
    pen.globalAlpha = alpha;
    pen.fillStyle = thing.color;
    pen.translate(...view.project(x, y, z));
    pen.beginPath();
    if (view === this.above) {
      pen.rotate(radians(yaw));
      if (thing.round) pen.arc(0, 0, length / 2, 0, 2 * Math.PI);
      else pen.rect(-length / 2, -width / 2, length, width);
    } else {
      const turn = radians(yaw);
      const extent = thing.round ? length : Math.abs(length * Math.cos(turn)) + Math.abs(width * Math.sin(turn));
      pen.rect(-extent / 2, -height / 2, extent, height);
    }
    pen.fill();
    pen.restore();
  }
}

// ---- the columns of a run

class RunData {
  constructor(values) {
    Object.assign(this, values);
    this.time = floats(values.time);
    for (const name of ["position", "velocity", "effort"]) this[name] = values[name].map(floats);
    this.state = bytes(values.state);
    this.age = floats(values.age);
    this.samples = {...values.samples, time: floats(values.samples.time), loop: floats(values.samples.loop),
      stages: values.samples.stages.map(floats)};
    this.moves = values.moves.map((columns) => columns && columns.map(floats));
    this.end = this.time[this.time.length - 1];
  }

  // Pose of a part: x, y, z, yaw.
  poseOf(number, at) {
    const columns = this.moves[number], part = this.scene.parts[number];
    if (!columns || columns[0][0] > at) return [part.at[0], part.at[1], part.z[0], part.at[2]];
    const row = indexAt(columns[0], at);
    return columns.slice(1).map((values) => values[row]);
  }

  tool(row) {
    const [l2, l3] = this.scene.links, one = radians(this.position[0][row]), both = one + radians(this.position[1][row]);
    return [l2 * Math.cos(one) + l3 * Math.cos(both), l2 * Math.sin(one) + l3 * Math.sin(both),
      this.scene.shoulder - this.position[2][row]];
  }

  trail(at, row) {
    const first = indexAt(this.time, at - TRAIL_S), stride = Math.max(1, (row - first) >> 8), points = [];
    for (let each = first; each < row; each += stride) points.push(this.tool(each));
    points.push(this.tool(row));
    return points;
  }
}

// ---- plots

class Plots {
  constructor(run, onSeek) {
    this.run = run;
    this.onSeek = onSeek;
    this.charts = [];
    this.from = run.time[0];
    this.until = run.end;
    this.container = element("div", {class: "plots"});
  }

  build() {
    this.charts.forEach((chart) => chart.destroy());
    this.charts = [];
    this.container.replaceChildren();
    const {run} = this, {joints, stages, colors, samples} = run, dash = [undefined, [6, 3], undefined, [2, 3]];
    const by = (columns, symbol, scale) => columns.map((values, joint) => ({
      label: joints[joint][symbol], stroke: joints[joint].color, dash: dash[joint], values,
      scale: scale && joint === 2 ? scale : "y",
    }));
    this.add("Joint positions", run.time, by(run.position, "symbol", "mm"), {y: "θ1, θ2, θ4, °", mm: "d3, mm"});
    this.add("Joint velocities", run.time, by(run.velocity, "symbol", "mm"), {y: "θ1, θ2, θ4, °/s", mm: "d3, mm/s"});
    this.add("Joint efforts", run.time, by(run.effort, "effort", "N"), {y: "τ1, τ2, τ4, N·m", N: "τ3, N"}, true);
    const age = withGaps(run.age);
    if (age.some((value) => value !== null)) {
      this.add("Age of the acting torque", run.time, [{label: "age", stroke: run.colors.age, values: age, scale: "y"}], {y: "age, ms"});
    }
    if (samples.time.length) {
      const series = samples.stages.map((values, number) => ({
        label: stages[number].title, stroke: stages[number].color, values, scale: "y", points: true}));
      series.unshift({label: "loop latency", stroke: color("--text"), values: samples.loop, scale: "y", points: true});
      this.add("Loop latency and its stages", samples.time, series, {y: "latency, ms"});
    }
    this.cursors = this.charts.map((chart) => {
      const cursor = element("div", {class: "playhead"});
      chart.over.append(cursor);
      return cursor;
    });
  }

  add(title, time, series, axes, stepped = false) {
    const box = element("figure", {class: "plot", role: "group", "aria-label": title});
    box.append(element("figcaption", {}, title));
    this.container.append(box);
    const axis = (name, number) => ({
      scale: name, label: axes[name], size: AXIS_PX, labelSize: 18, side: number ? 1 : 3, stroke: color("--quiet"),
      labelFont: "12px system-ui, sans-serif", font: "11px system-ui, sans-serif",
      grid: {show: number === 0, stroke: color("--line"), width: 1}, ticks: {stroke: color("--line"), width: 1},
    });
    const names = Object.keys(axes);
    // Equal margins on both sides align the time axes of all plots.
    const spare = names.length === 1 ? [{scale: "y", side: 1, size: AXIS_PX, label: " ", labelSize: 18, values: () => [], grid: {show: false}, ticks: {show: false}}] : [];
    const chart = new uPlot({
      width: this.width(), height: 190, legend: {live: true},
      // The whole range is that of the run, also for samples that begin later.
      scales: {x: {time: false, range: (_, min, max) => (min === time[0] && max === time[time.length - 1] ? [this.run.time[0], this.run.end] : [min, max])}},
      cursor: {sync: {key: this.run.id, setSeries: false}, drag: {x: true, y: false}, points: {size: 5}},
      series: [{label: "time, s", value: (_, value) => fixed(value, 3)}, ...series.map((one) => ({
        label: one.label, stroke: one.stroke, dash: one.dash, scale: one.scale, width: 1.3,
        paths: one.points ? () => null : stepped ? uPlot.paths.stepped({align: 1}) : undefined,
        points: one.points ? {show: true, size: 3, stroke: one.stroke, fill: one.stroke} : {show: false},
        value: (_, value) => fixed(value ?? null, 2),
      }))],
      axes: [
        {label: "time since start, s", labelSize: 16, size: 34, stroke: color("--quiet"), labelFont: "12px system-ui, sans-serif",
          font: "11px system-ui, sans-serif", grid: {stroke: color("--line"), width: 1}, ticks: {stroke: color("--line"), width: 1}},
        ...names.map(axis), ...spare,
      ],
      hooks: {
        setScale: [(changed, name) => name === "x" && this.zoom(changed)],
        drawAxes: [(drawn) => this.drawMarks(drawn)],
        ready: [(made) => this.bindSeek(made)],
      },
    }, [time, ...series.map((one) => one.values)], box);
    this.charts.push(chart);
  }

  width() {
    return Math.max(240, this.container.clientWidth - 2);
  }

  bindSeek(chart) {
    let downAt = null;
    chart.over.addEventListener("mousedown", (event) => (downAt = event.clientX));
    chart.over.addEventListener("click", (event) => {
      // A drag selects a range to zoom into.
      if (downAt === null || Math.abs(event.clientX - downAt) > 3) return;
      this.onSeek(chart.posToVal(event.clientX - chart.over.getBoundingClientRect().left, "x"));
    });
  }

  zoom(changed) {
    const {min, max} = changed.scales.x;
    if (this.zooming || min === null) return;
    this.zooming = true;
    this.from = min;
    this.until = max;
    for (const chart of this.charts) if (chart !== changed) chart.setScale("x", {min, max});
    this.zooming = false;
    if (this.at !== undefined) this.move(this.at);
  }

  resize() {
    const width = this.width();
    for (const chart of this.charts) if (chart.width !== width) chart.setSize({width, height: chart.height});
    this.move(this.at);
  }

  drawMarks(chart) {
    const pen = chart.ctx, {left, top, width, height} = chart.bbox;
    const mark = (time, stroke, dash) => {
      if (time === null || time < chart.scales.x.min || time > chart.scales.x.max) return;
      const x = Math.round(chart.valToPos(time, "x", true)) + 0.5;
      pen.beginPath();
      pen.setLineDash(dash);
      pen.moveTo(x, top);
      pen.lineTo(x, top + height);
      pen.strokeStyle = stroke;
      pen.stroke();
    };
    pen.save();
    pen.beginPath();
    pen.rect(left, top, width, height);
    pen.clip();
    pen.lineWidth = devicePixelRatio || 1;
    for (const event of this.run.events) mark(event.time, event.color, [2, 3]);
    for (const goal of this.run.goals) mark(goal.time, color("--good"), []);
    pen.restore();
  }

  // Moves the time mark of each plot; the plots themselves are not drawn again.
  move(at) {
    this.at = at;
    this.charts.forEach((chart, number) => {
      // Without the pointer in a plot, the legends show the values at the time mark.
      if (!chart.cursor.left || chart.cursor.left < 0) chart.setLegend({idx: indexAt(chart.data[0], at + 1e-6)}, false);
      const x = chart.valToPos(at, "x"), visible = x >= 0 && x <= chart.over.clientWidth;
      this.cursors[number].style.display = visible ? "" : "none";
      if (visible) this.cursors[number].style.transform = `translateX(${x}px)`;
    });
  }
}

// ---- player

class Player {
  constructor(root, values) {
    this.root = root;
    this.run = new RunData({...values, id: root.id});
    this.at = this.run.time[0];
    this.playing = false;
    this.arm = new Arm(this.run);
    this.plots = new Plots(this.run, (at) => this.seek(at));
    this.build();
  }

  build() {
    const {run} = this;
    this.button = element("button", {type: "button", class: "play"}, "Play");
    this.slider = element("input", {type: "range", min: run.time[0], max: run.end, step: "any", "aria-label": "time in the run"});
    this.speed = element("select", {"aria-label": "speed"}, ...SPEEDS.map((speed) => element("option", {value: speed}, `${speed} ×`)));
    this.speed.value = "1";
    this.readout = element("output", {class: "time"});
    this.reset = element("button", {type: "button"}, "Whole run");
    const names = ["", "position", "velocity", "effort"];
    this.cells = run.joints.map(() => [0, 1, 2].map(() => element("td")));
    const rows = run.joints.map((joint, number) => {
      const swatch = element("span", {class: "swatch"});
      swatch.style.background = joint.color;
      const units = number === 2 ? ["mm", "mm/s", "N"] : ["°", "°/s", "N·m"];
      const cells = this.cells[number].flatMap((cell, column) => [cell, element("td", {class: "unit"}, units[column])]);
      return element("tr", {}, element("th", {scope: "row"}, swatch, `${joint.symbol}`), ...cells);
    });
    const head = element("tr", {}, ...names.map((name, number) => element("th", number ? {scope: "col", colspan: 2} : {}, name)));
    this.note = element("p", {class: "now"});
    const values = element("table", {class: "values"}, element("thead", {}, head), element("tbody", {}, ...rows));
    const bar = element("div", {class: "bar"}, this.button, this.slider, this.readout, this.speed, this.reset);
    const views = element("div", {class: "views"}, ...this.arm.figures, element("div", {class: "panel"}, values, this.note));
    const hint = element("p", {class: "quiet"}, "Drag in a plot to zoom into a time range, double-click for the whole run, click to go to a time. " +
      "Dotted lines are events, solid green lines reached goals." +
      (run.every > 1 ? ` One of ${run.every} states is shown; age and latency are the largest of each group.` : ""));
    this.root.replaceChildren(bar, views, hint, this.plots.container);
    this.buildEvents();
    this.button.addEventListener("click", () => this.toggle());
    this.slider.addEventListener("input", () => this.seek(Number(this.slider.value)));
    this.slider.addEventListener("keydown", (event) => this.onKey(event));
    this.reset.addEventListener("click", () => this.plots.charts[0].setScale("x", {min: run.time[0], max: run.end}));
    this.plots.build();
    this.seek(this.at);
    new ResizeObserver(() => { this.plots.resize(); this.draw(); }).observe(this.plots.container);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { this.plots.build(); this.seek(this.at); });
  }

  // The list of events is made on the server; here its rows become links to their times.
  buildEvents() {
    this.rows = [...document.querySelectorAll(`[data-run="${this.root.id}"]`)];
    for (const row of this.rows) {
      const button = row.querySelector("button");
      if (button) button.addEventListener("click", () => { this.seek(Number(button.dataset.time)); this.root.scrollIntoView({block: "start"}); });
    }
  }

  onKey(event) {
    const steps = KEY_STEPS[event.key];
    if (!steps) return;
    event.preventDefault();
    const row = Math.min(Math.max(indexAt(this.run.time, this.at + 1e-6) + steps, 0), this.run.time.length - 1);
    this.seek(this.run.time[row]);
  }

  toggle() {
    this.playing = !this.playing;
    this.button.textContent = this.playing ? "Pause" : "Play";
    if (!this.playing) return;
    if (this.at >= this.run.end) this.at = this.run.time[0];
    this.last = performance.now();
    requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    if (!this.playing) return;
    this.at += (Number(this.speed.value) * Math.max(now - this.last, 0)) / 1000;
    this.last = now;
    if (this.at >= this.run.end) this.toggle();
    this.seek(Math.min(this.at, this.run.end));
    requestAnimationFrame((next) => this.frame(next));
  }

  seek(at) {
    this.at = Math.min(Math.max(at, this.run.time[0]), this.run.end);
    this.slider.value = this.at;
    this.draw();
  }

  draw() {
    const {run, at} = this, row = indexAt(run.time, at + 1e-6);
    this.arm.draw(at, row);
    this.plots.move(at);
    const text = `${fixed(at, 2)} s of ${fixed(run.end, 2)} s`;
    this.readout.textContent = text;
    this.slider.setAttribute("aria-valuetext", text);
    this.cells.forEach((cells, joint) => {
      cells[0].textContent = fixed(run.position[joint][row], 2);
      cells[1].textContent = fixed(run.velocity[joint][row], 1);
      cells[2].textContent = fixed(run.effort[joint][row], 2);
    });
    const flags = run.state[row], notes = [`age of the acting torque ${fixed(run.age[row], 1)} ms`];
    notes.push(flags & run.flags.holds ? "magnet holds a part" : flags & run.flags.magnet ? "magnet on" : "magnet off");
    if (flags & run.flags.stop) notes.push("at a stop or in contact");
    this.note.textContent = notes.join(" · ");
  }
}

// ---- page

function start(root) {
  if (root.player) return;
  root.player = new Player(root, JSON.parse(document.getElementById(`${root.id}-data`).textContent));
}

for (const root of document.querySelectorAll(".player")) {
  const details = root.closest("details");
  if (details && !details.open) details.addEventListener("toggle", () => start(root), {once: true});
  else start(root);
}
