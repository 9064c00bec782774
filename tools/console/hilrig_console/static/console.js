"use strict";
// Live view of a lab from server-sent events: `lab` once per second, `poses` five times per second, and each `event`.
// All values are inserted as text, never as HTML.

const SVG = "http://www.w3.org/2000/svg";
const MAX_EVENTS = 200;
const TIMEOUT_MS = 4000;
const MAX_CARDS = 60;
const MAX_REFUSED = 50;
const ANIMATION_MS = 200;
const HOLDS_PART = 2, MAGNET_ON = 1;
const LEVELS = {"in use": "good", "free": "", "no command": "warn", "watchdog tripped": "bad", "no edge": "bad", "no simulation": "bad"};
const SEVERITIES = {info: "", warning: "warn", error: "bad"};
const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)");

const byId = (id) => document.getElementById(id);
const fixed = (value, digits) => value === null || value === undefined ? "–" : value.toFixed(digits);
const count = (number, thing) => `${number} ${thing}${number === 1 ? "" : "s"}`;
const pathOf = (path) => path.split("/").map(encodeURIComponent).join("/");

function html(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

function svg(name, attributes = {}) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  return element;
}

function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function setLevel(element, level) {
  if (element.dataset.level !== level) element.dataset.level = level;
}

// ---- top view of an arm: x to the right, y up, millimeters

class Arm {
  constructor(rig) {
    this.svg = svg("svg", {class: "arm stale", role: "img", "aria-label": `Arm of ${rig}`});
    this.title = svg("title");
    this.title.textContent = `Arm of ${rig}, top view; tool height on the right`;
    this.scene = null;
    this.shown = this.target = null;
    this.seen = false;
  }

  build(scene) {
    this.scene = scene;
    const span = scene.span * 1.07, wide = span * 2.22;
    this.svg.setAttribute("viewBox", `${-span} ${-span} ${wide} ${span * 2}`);
    const world = svg("g", {transform: "scale(1 -1)"});
    world.append(svg("path", {class: "reach", d: scene.reach}));
    for (const tray of scene.trays) {
      const [x, y, yaw] = tray.at, [w, h] = tray.size;
      world.append(svg("rect", {class: "tray", fill: tray.color, x: -w / 2, y: -h / 2, width: w, height: h,
        transform: `translate(${x} ${y}) rotate(${yaw})`}));
      for (const [px, py] of tray.places) world.append(svg("circle", {class: "place", cx: px, cy: py, r: 22}));
    }
    this.parts = scene.parts.map((part) => {
      const [w, h] = part.size;
      const shape = part.round ? svg("circle", {r: w / 2}) : svg("rect", {x: -w / 2, y: -h / 2, width: w, height: h});
      shape.setAttribute("class", "part");
      shape.setAttribute("fill", part.color);
      world.append(shape);
      return shape;
    });
    this.place(scene.parts.map((part) => part.at));
    this.one = svg("line", {class: "one", x1: 0, y1: 0});
    this.two = svg("line", {class: "two"});
    this.elbow = svg("circle", {class: "elbow", r: 16});
    this.tool = svg("circle", {class: "tool", r: 24});
    world.append(this.one, this.two, svg("circle", {class: "base", r: 34}), this.elbow, this.tool);
    const rail = span * 1.12;
    world.append(svg("line", {class: "rail", x1: rail, x2: rail, y1: -span * 0.8, y2: span * 0.8}));
    this.height = svg("circle", {class: "height", cx: rail, r: 22});
    world.append(this.height);
    this.svg.replaceChildren(this.title, world);
    this.shown = null;
  }

  place(parts) {
    parts.forEach(([x, y, yaw], number) => {
      if (this.parts[number]) this.parts[number].setAttribute("transform", `translate(${x} ${y}) rotate(${yaw})`);
    });
  }

  update(scene, pose, parts) {
    if (scene !== this.scene) this.build(scene);
    if (parts.length) this.place(parts);
    this.tool.setAttribute("class", `tool${pose[5] & HOLDS_PART ? " holds" : pose[5] & MAGNET_ON ? " on" : ""}`);
    this.from = this.shown || pose;
    this.target = pose;
    this.since = performance.now();
    this.svg.classList.remove("stale");
  }

  markStale() {
    this.svg.classList.add("stale");
  }

  // Interpolates between two poses; returns true until the target is reached.
  animate(now) {
    const share = reducedMotion.matches ? 1 : Math.min(1, (now - this.since) / ANIMATION_MS);
    const [ex, ey, x, y, z] = this.shown = this.target.slice(0, 5).map((to, i) => this.from[i] + (to - this.from[i]) * share);
    for (const [key, value] of [["x2", ex], ["y2", ey]]) this.one.setAttribute(key, value);
    for (const [key, value] of [["x1", ex], ["y1", ey], ["x2", x], ["y2", y]]) this.two.setAttribute(key, value);
    this.elbow.setAttribute("cx", ex);
    this.elbow.setAttribute("cy", ey);
    this.tool.setAttribute("cx", x);
    this.tool.setAttribute("cy", y);
    const {top, bottom, span} = this.scene;
    this.height.setAttribute("cy", span * 1.07 * 0.8 * (2 * (z - bottom) / (top - bottom) - 1));
    return share < 1;
  }
}

// ---- a rig as a card and as a table row

const FIGURES = [
  ["loop", "loop latency p50 / p99", "big wide"], ["age", "age p99", ""], ["late", "lateness", ""], ["overruns", "overruns", ""], ["watchdog", "watchdog", ""],
  ["controller", "controller", "line"], ["address", "address", "line"], ["recorded", "session", "wide"],
];

class Rig {
  constructor(name) {
    this.name = name;
    this.arm = new Arm(name);
    this.pill = html("span", {class: "pill"});
    this.figures = {};
    const figures = html("dl", {class: "figures"});
    for (const [key, title, kind] of FIGURES) {
      const value = this.figures[key] = html("dd", kind.includes("big") ? {class: "big"} : {});
      figures.append(html("div", {class: kind.replace("big ", "")}, html("dt", {}, title), value));
    }
    this.card = html("li", {}, html("div", {class: "head"}, html("h3", {title: name}, name), this.pill), this.arm.svg, figures);
    this.card.rig = this;
    this.rowPill = html("span", {class: "pill"});
    this.cells = ["", "", "n", "n", "n", "n", "n", "", ""].map((kind) => html("td", kind ? {class: kind} : {}));
    this.row = html("tr", {}, html("th", {scope: "row"}, name), html("td", {}, this.rowPill), ...this.cells);
  }

  update(rig, runs) {
    this.held = Boolean(rig.controller);
    this.level = runs ? LEVELS[rig.state] ?? "warn" : "";
    const user = [rig.student, rig.controller || "none"].filter(Boolean).join(": ");
    this.text = `${rig.rig} ${rig.state} ${rig.student || ""} ${rig.controller} ${rig.address} ${rig.session}`.toLowerCase();
    const recorded = rig.recording ? rig.session || "manual recording" : "–";
    const p50 = fixed(rig.loop_p50_ms, 1), p99 = fixed(rig.loop_p99_ms, 1), late = fixed(rig.simulated ? rig.lateness_p99_ms : null, 2);
    for (const pill of [this.pill, this.rowPill]) {
      setText(pill, rig.state);
      setLevel(pill, this.level);
    }
    setLevel(this.card, this.level);
    setText(this.figures.loop, rig.loop_samples ? `${p50} / ${p99} ms` : "–");
    const age = fixed(rig.age_p99_ms, 1);
    setText(this.figures.age, rig.age_p99_ms === null ? age : `${age} ms`);
    setText(this.figures.controller, user);
    setText(this.figures.address, rig.address || "–");
    setText(this.figures.late, rig.simulated ? `${late} ms` : late);
    setText(this.figures.overruns, rig.simulated ? String(rig.overruns) : "–");
    const watchdog = rig.served ? rig.watchdog_tripped ? "tripped" : "armed" : "–";
    setText(this.figures.watchdog, watchdog);
    setText(this.figures.recorded, recorded);
    this.figures.recorded.classList.toggle("rec", rig.recording);
    this.figures.recorded.title = recorded;
    const cells = [rig.address || "–", user, p50, p99, age, late, rig.simulated ? String(rig.overruns) : "–", watchdog, recorded];
    cells.forEach((text, number) => setText(this.cells[number], text));
    this.cells[8].classList.toggle("rec", rig.recording);
  }

  matches(terms, which) {
    return terms.every((term) => this.text.includes(term))
      && (which === "all" || (which === "held" ? this.held : this.level === "bad"));
  }
}

// ---- page content

const rigs = new Map();
let poses = {}, scenes = [], scenesVersion = -1, runsVersion = -1, receivedMs = 0, animating = false, selectedView = "";
const urlState = new URLSearchParams(location.hash.slice(1));
const visible = new IntersectionObserver((entries) => {
  for (const entry of entries) entry.target.rig.arm.seen = entry.isIntersecting;
  showPoses(poses);
});

function showLab(lab) {
  receivedMs = Date.now();
  document.title = `hilrig · ${lab.lab}`;
  setText(byId("lab"), lab.lab);
  const names = new Set(lab.rigs.map((rig) => rig.rig));
  for (const [name, rig] of rigs) {
    if (names.has(name)) continue;
    visible.unobserve(rig.card);
    rig.card.remove();
    rig.row.remove();
    rigs.delete(name);
  }
  // Without services, the rigs are not marked as faulty.
  const runs = lab.services.some((service) => !service.silent);
  const cards = byId("cards"), rows = byId("rows").querySelector("tbody");
  for (const status of lab.rigs) {
    let rig = rigs.get(status.rig);
    if (!rig) {
      rigs.set(status.rig, rig = new Rig(status.rig));
      cards.append(rig.card);
      rows.append(rig.row);
      visible.observe(rig.card);
    }
    rig.update(status, runs);
  }
  const alarms = [...rigs.values()].filter((rig) => rig.level === "bad").length;
  const totals = [[rigs.size, rigs.size === 1 ? "rig" : "rigs"], [lab.rigs.filter((rig) => rig.controller).length, "in use"],
    [lab.rigs.filter((rig) => rig.recording).length, "recording"]];
  if (alarms) totals.push([alarms, alarms === 1 ? "alarm" : "alarms"]);
  byId("summary").replaceChildren(...totals.map(([number, label]) =>
    html("li", label.startsWith("alarm") ? {class: "alarm"} : {}, html("b", {}, String(number)), ` ${label}`)));
  const alerts = lab.alerts.map((text) => ["warn", text]);
  if (lab.bus_error) alerts.unshift(["bad", lab.bus_error]);
  else if (!runs) {
    alerts.unshift(["bad", `No services of the lab “${lab.lab}” found: start it with “hilrig up” and the same lab.toml.`]);
  }
  const list = byId("alerts"), before = [...list.children].map((item) => item.textContent).join("\n");
  if (before !== alerts.map(([, text]) => text).join("\n")) {
    list.replaceChildren(...alerts.map(([level, text]) => html("li", {"data-level": level}, text)));
  }
  showServices(lab.services);
  showRefused(lab.rigs);
  arrange();
  if (lab.scenes !== scenesVersion) fetchScenes(lab.scenes);
  if (lab.runs !== runsVersion) fetchRuns(lab.runs);
}

function showServices(services) {
  const table = byId("services");
  byId("services-none").hidden = services.length > 0;
  table.parentElement.hidden = services.length === 0;
  table.tBodies[0].replaceChildren(...services.map((service) => {
    const cells = [service.host, service.rigs, service.cpu_percent.toFixed(0), service.memory_mib.toFixed(0),
      service.lateness_p99_ms.toFixed(2), service.overruns, service.lost_transport + service.lost_recorder,
      service.clock_peer ? `${service.clock_offset_ms < 0 ? "−" : "+"}${Math.abs(service.clock_offset_ms).toFixed(1)} ± ${service.clock_uncertainty_ms.toFixed(1)}` : "–"];
    const row = html("tr", service.silent || service.alert ? {"data-level": "bad"} : {},
      html("th", {scope: "row"}, `${service.service}/${service.instance}${service.silent ? " (silent)" : ""}`));
    row.append(...cells.map((cell, number) => html("td", number ? {class: "n"} : {}, String(cell))));
    return row;
  }));
}

// Modbus exception responses since the start of each edge, the most frequent ones first.
function showRefused(rigs) {
  const rows = rigs.flatMap((rig) => rig.exceptions.map((refused) => [rig.rig, refused]));
  rows.sort(([, one], [, other]) => other.count - one.count);
  byId("refused-panel").hidden = rows.length === 0;
  const more = byId("refused-more");
  more.hidden = rows.length <= MAX_REFUSED;
  setText(more, `The ${MAX_REFUSED} most frequent of ${rows.length}`);
  byId("refused").tBodies[0].replaceChildren(...rows.slice(0, MAX_REFUSED).map(([rig, refused]) => {
    const row = html("tr", {}, html("th", {scope: "row"}, rig), html("td", {}, refused.host));
    const code = refused.code.toString(16).toUpperCase().padStart(2, "0");
    row.append(...[refused.function, code, refused.count].map((cell) => html("td", {class: "n"}, String(cell))));
    return row;
  }));
}

function arrange() {
  const terms = byId("rig-search").value.toLowerCase().split(/\s+/).filter(Boolean), which = byId("which").value;
  let shown = 0;
  for (const rig of rigs.values()) {
    const hidden = !rig.matches(terms, which);
    shown += hidden ? 0 : 1;
    if (rig.card.hidden !== hidden) rig.card.hidden = rig.row.hidden = hidden;
  }
  const none = byId("rigs-none");
  none.hidden = shown > 0;
  setText(none, rigs.size ? "No rig matches." : "No rigs.");
  const asTable = (selectedView || (rigs.size > MAX_CARDS ? "table" : "cards")) === "table";
  byId("cards").hidden = asTable;
  byId("rows").hidden = !asTable || shown === 0;
  byId("as-cards").setAttribute("aria-pressed", String(!asTable));
  byId("as-table").setAttribute("aria-pressed", String(asTable));
}

// Poses are sent when they change; a card that is scrolled into view gets the latest ones.
function showPoses(latest) {
  poses = latest;
  for (const rig of rigs.values()) {
    const pose = poses[rig.name], scene = pose && scenes[pose[0]];
    if (!scene) rig.arm.markStale();
    else if (rig.arm.seen || !rig.arm.scene) rig.arm.update(scene, pose[1], pose[2]);
  }
  if (!animating) {
    animating = true;
    requestAnimationFrame(animate);
  }
}

function animate(now) {
  animating = false;
  for (const rig of rigs.values()) {
    const arm = rig.arm;
    if (arm.target && (arm.seen || !arm.shown) && arm.shown !== arm.target) {
      if (arm.animate(now)) animating = true;
      else arm.shown = arm.target;
    }
  }
  if (animating) requestAnimationFrame(animate);
}

function showEvent(event) {
  const list = byId("events"), when = new Date(event.wall_ms);
  const item = html("li", {"data-level": SEVERITIES[event.severity] ?? "warn"},
    html("time", {datetime: when.toISOString(), title: when.toLocaleString()}, when.toLocaleTimeString()),
    html("span", {}, html("b", {}, event.rig || event.source), ` ${event.text}`));
  list.prepend(item);
  while (list.children.length > MAX_EVENTS) list.lastElementChild.remove();
  byId("events-none").hidden = true;
}

function lengthOf(seconds) {
  if (seconds < 60) return `${seconds.toFixed(1)} s`;
  const total = Math.round(seconds), two = (number) => String(number).padStart(2, "0");
  const minutes = Math.floor(total / 60);
  return minutes < 60 ? `${minutes}:${two(total % 60)}` : `${Math.floor(minutes / 60)}:${two(minutes % 60)}:${two(total % 60)}`;
}

function sizeOf(bytes) {
  for (const unit of ["B", "KiB", "MiB"]) {
    if (bytes < 1024) return `${bytes.toFixed(unit === "MiB" ? 1 : 0)} ${unit}`;
    bytes /= 1024;
  }
  return `${bytes.toFixed(1)} GiB`;
}

function showRuns(list) {
  const table = byId("runs");
  table.parentElement.hidden = list.runs.length === 0;
  const more = list.found > list.runs.length ? `, latest ${list.runs.length} shown` : "";
  setText(byId("runs-count"), list.error || (list.found === list.total ? `${list.total}${more}` : `${list.found} of ${list.total}${more}`));
  table.tBodies[0].replaceChildren(...list.runs.map((run) => {
    const start = run.start_ms ? new Date(run.start_ms).toLocaleString() : run.name;
    const row = html("tr", run.error ? {"data-level": "bad"} : {}, html("th", {scope: "row", title: run.path}, start),
      html("td", {}, run.rig));
    const links = html("td");
    if (!run.open && !run.error) {
      links.append(html("a", {href: `reports/${pathOf(run.path)}`, target: "_blank", rel: "noopener",
        "aria-label": `Report of ${run.name}`}, "Report"));
    }
    const files = run.open ? [] : run.segments.length ? run.segments : [run.path];
    files.forEach((path, number) => {
      const label = files.length > 1 ? ` ${number + 1}` : "";
      links.append(html("a", {href: `recordings/${pathOf(path)}`, download: "", "aria-label": `Recording ${run.name}${label}`}, `MCAP${label}`));
    });
    if (run.error) {
      row.append(html("td", {class: "long", colspan: "9"}, run.error), links);
      return row;
    }
    const lost = run.lost_transport + run.lost_recorder + run.lost_file;
    const fit = html("td", run.fit === null ? {} : {class: run.fit ? "good" : "bad", title: run.unfit}, run.fit === null ? "–" : run.fit ? "yes" : "no");
    const figures = [run.open ? "–" : lengthOf(run.duration_s), sizeOf(run.size), fixed(run.loop_p50_ms, 1), fixed(run.loop_p99_ms, 1), fixed(run.age_p99_ms, 1)];
    row.append(html("td", {}, run.controller || "none"), ...figures.map((text) => html("td", {class: "n"}, text)),
      html("td", {class: lost ? "n bad" : "n"}, String(lost)), fit, html("td", {title: run.reason}, [run.open ? "recording" : run.ended, ...run.overlaps.map((session) => `overlaps with ${session}`)].join("; ")), links);
    return row;
  }));
}

// ---- requests

async function fetchScenes(version) {
  scenesVersion = version;
  try {
    scenes = await (await fetch("scenes")).json();
    showPoses(poses);
  } catch {
    scenesVersion = -1;
  }
}

async function fetchRuns(version) {
  runsVersion = version;
  const query = byId("run-search").value;
  try {
    const list = await (await fetch(`runs?query=${encodeURIComponent(query)}`)).json();
    if (query === byId("run-search").value) showRuns(list);
  } catch {
    runsVersion = -1;
  }
}

function listen() {
  const source = new EventSource("live");
  const on = (name, show) => source.addEventListener(name, (message) => show(JSON.parse(message.data)));
  source.onopen = () => {
    // The console may have been restarted; its version numbers are different.
    scenesVersion = runsVersion = -1;
  };
  source.onerror = () => {
    receivedMs = 0;
    updateLink();
    if (source.readyState === EventSource.CLOSED) setTimeout(listen, 3000);
  };
  on("lab", showLab);
  on("poses", showPoses);
  on("event", showEvent);
}

function updateLink() {
  const link = byId("link"), live = Date.now() - receivedMs < TIMEOUT_MS;
  setLevel(link, live ? "good" : "bad");
  setText(link, live ? "live" : "no connection to the console");
  document.body.classList.toggle("disconnected", !live);
  if (!live) for (const rig of rigs.values()) rig.arm.markStale();
}

function saveView() {
  for (const [key, value] of [["rigs", byId("rig-search").value], ["which", byId("which").value === "all" ? "" : byId("which").value], ["view", selectedView]]) {
    if (value) urlState.set(key, value);
    else urlState.delete(key);
  }
  history.replaceState(null, "", urlState.size ? `#${urlState}` : location.pathname);
  arrange();
}

byId("rig-search").value = urlState.get("rigs") || "";
if (["held", "alarm"].includes(urlState.get("which"))) byId("which").value = urlState.get("which");
selectedView = ["cards", "table"].includes(urlState.get("view")) ? urlState.get("view") : "";
byId("rig-search").addEventListener("input", saveView);
byId("which").addEventListener("change", saveView);
for (const view of ["cards", "table"]) byId(`as-${view}`).addEventListener("click", () => { selectedView = view; saveView(); });
let searchTimer = 0;
byId("run-search").addEventListener("input", () => { clearTimeout(searchTimer); searchTimer = setTimeout(() => fetchRuns(runsVersion), 200); });
setInterval(updateLink, 1000);
listen();
