"use strict";
// The lab as its console sends it: `lab` once a second, `poses` five times, `event` as they happen. Whatever a lab says
// is set as text, never as HTML.

const SVG = "http://www.w3.org/2000/svg";
const EVENTS_KEPT = 200;
const QUIET_MS = 4000;
const CARDS_AT_MOST = 60;
const GLIDE_MS = 200;
const HOLDS = 2, MAGNET = 1;
const LEVELS = {"in use": "good", "free": "", "no command": "warn", "watchdog tripped": "bad", "no edge": "bad", "no simulation": "bad"};
const SEVERITIES = {info: "", warning: "warn", error: "bad"};
const stillness = matchMedia("(prefers-reduced-motion: reduce)");

const at = (id) => document.getElementById(id);
const fixed = (value, digits) => value === null || value === undefined ? "–" : value.toFixed(digits);
const count = (number, thing) => `${number} ${thing}${number === 1 ? "" : "s"}`;
const pathOf = (path) => path.split("/").map(encodeURIComponent).join("/");

function made(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

function drawn(name, attributes = {}) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  return element;
}

function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function mark(element, level) {
  if (element.dataset.level !== level) element.dataset.level = level;
}

// ---- a rig's arm, from above: x to the right, y up, millimetres

class Arm {
  constructor(rig) {
    this.svg = drawn("svg", {class: "arm stale", role: "img", "aria-label": `The arm of ${rig}`});
    this.title = drawn("title");
    this.title.textContent = `The arm of ${rig} from above; at the right, how high its tool is`;
    this.scene = null;
    this.shown = this.wanted = null;
    this.seen = false;
  }

  build(scene) {
    this.scene = scene;
    const span = scene.span * 1.07, wide = span * 2.22;
    this.svg.setAttribute("viewBox", `${-span} ${-span} ${wide} ${span * 2}`);
    const world = drawn("g", {transform: "scale(1 -1)"});
    world.append(drawn("path", {class: "reach", d: scene.reach}));
    for (const tray of scene.trays) {
      const [x, y, yaw] = tray.at, [w, h] = tray.size;
      world.append(drawn("rect", {class: "tray", fill: tray.colour, x: -w / 2, y: -h / 2, width: w, height: h,
        transform: `translate(${x} ${y}) rotate(${yaw})`}));
      for (const [px, py] of tray.places) world.append(drawn("circle", {class: "place", cx: px, cy: py, r: 22}));
    }
    this.parts = scene.parts.map((part) => {
      const [w, h] = part.size;
      const shape = part.round ? drawn("circle", {r: w / 2}) : drawn("rect", {x: -w / 2, y: -h / 2, width: w, height: h});
      shape.setAttribute("class", "part");
      shape.setAttribute("fill", part.colour);
      world.append(shape);
      return shape;
    });
    this.place(scene.parts.map((part) => part.at));
    this.one = drawn("line", {class: "one", x1: 0, y1: 0});
    this.two = drawn("line", {class: "two"});
    this.elbow = drawn("circle", {class: "elbow", r: 16});
    this.tool = drawn("circle", {class: "tool", r: 24});
    world.append(this.one, this.two, drawn("circle", {class: "base", r: 34}), this.elbow, this.tool);
    const rail = span * 1.12;
    world.append(drawn("line", {class: "rail", x1: rail, x2: rail, y1: -span * 0.8, y2: span * 0.8}));
    this.height = drawn("circle", {class: "height", cx: rail, r: 22});
    world.append(this.height);
    this.svg.replaceChildren(this.title, world);
    this.shown = null;
  }

  place(parts) {
    parts.forEach(([x, y, yaw], number) => {
      if (this.parts[number]) this.parts[number].setAttribute("transform", `translate(${x} ${y}) rotate(${yaw})`);
    });
  }

  take(scene, pose, parts) {
    if (scene !== this.scene) this.build(scene);
    if (parts.length) this.place(parts);
    this.tool.setAttribute("class", `tool${pose[5] & HOLDS ? " holds" : pose[5] & MAGNET ? " on" : ""}`);
    this.from = this.shown || pose;
    this.wanted = pose;
    this.since = performance.now();
    this.svg.classList.remove("stale");
  }

  lost() {
    this.svg.classList.add("stale");
  }

  // Between two poses the arm glides; true: it has not arrived.
  glide(now) {
    const share = stillness.matches ? 1 : Math.min(1, (now - this.since) / GLIDE_MS);
    const [ex, ey, x, y, z] = this.shown = this.wanted.slice(0, 5).map((to, i) => this.from[i] + (to - this.from[i]) * share);
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

// ---- a rig, as a card and as a row

const FIGURES = [
  ["loop", "loop p50 / p99", "big wide"], ["late", "tick p99", ""], ["overruns", "overruns", ""], ["watchdog", "watchdog", ""],
  ["controller", "controller", "line"], ["address", "address", "line"], ["recorded", "recorded as", "wide"],
];

class Rig {
  constructor(name) {
    this.name = name;
    this.arm = new Arm(name);
    this.pill = made("span", {class: "pill"});
    this.figures = {};
    const figures = made("dl", {class: "figures"});
    for (const [key, title, kind] of FIGURES) {
      const value = this.figures[key] = made("dd", kind.includes("big") ? {class: "big"} : {});
      figures.append(made("div", {class: kind.replace("big ", "")}, made("dt", {}, title), value));
    }
    this.card = made("li", {}, made("div", {class: "head"}, made("h3", {title: name}, name), this.pill), this.arm.svg, figures);
    this.card.rig = this;
    this.rowPill = made("span", {class: "pill"});
    this.cells = ["", "", "n", "n", "n", "n", "", ""].map((kind) => made("td", kind ? {class: kind} : {}));
    this.row = made("tr", {}, made("th", {scope: "row"}, name), made("td", {}, this.rowPill), ...this.cells);
  }

  update(rig, runs) {
    this.held = Boolean(rig.controller);
    this.level = runs ? LEVELS[rig.state] ?? "warn" : "";
    this.text = `${rig.rig} ${rig.state} ${rig.controller} ${rig.address} ${rig.session}`.toLowerCase();
    const recorded = rig.recording ? rig.session || "by hand" : "–";
    const p50 = fixed(rig.loop_p50_ms, 1), p99 = fixed(rig.loop_p99_ms, 1), late = fixed(rig.simulated ? rig.lateness_p99_ms : null, 2);
    for (const pill of [this.pill, this.rowPill]) {
      say(pill, rig.state);
      mark(pill, this.level);
    }
    mark(this.card, this.level);
    say(this.figures.loop, rig.loop_samples ? `${p50} / ${p99} ms` : "–");
    say(this.figures.controller, rig.controller || "nobody");
    say(this.figures.address, rig.address || "–");
    say(this.figures.late, rig.simulated ? `${late} ms` : late);
    say(this.figures.overruns, rig.simulated ? String(rig.overruns) : "–");
    const watchdog = rig.served ? rig.watchdog_tripped ? "tripped" : "armed" : "–";
    say(this.figures.watchdog, watchdog);
    say(this.figures.recorded, recorded);
    this.figures.recorded.classList.toggle("rec", rig.recording);
    this.figures.recorded.title = recorded;
    const cells = [rig.address || "–", rig.controller || "nobody", p50, p99, late, rig.simulated ? String(rig.overruns) : "–", watchdog, recorded];
    cells.forEach((text, number) => say(this.cells[number], text));
    this.cells[7].classList.toggle("rec", rig.recording);
  }

  matches(words, which) {
    return words.every((word) => this.text.includes(word))
      && (which === "all" || (which === "held" ? this.held : this.level === "bad"));
  }
}

// ---- what is shown

const rigs = new Map();
let poses = {}, scenes = [], scenesWanted = -1, runsShown = -1, heardMs = 0, gliding = false, chosenView = "";
const place = new URLSearchParams(location.hash.slice(1));
const visible = new IntersectionObserver((entries) => {
  for (const entry of entries) entry.target.rig.arm.seen = entry.isIntersecting;
  showPoses(poses);
});

function showLab(lab) {
  heardMs = Date.now();
  document.title = `hilrig · ${lab.lab}`;
  say(at("lab"), lab.lab);
  const names = new Set(lab.rigs.map((rig) => rig.rig));
  for (const [name, rig] of rigs) {
    if (names.has(name)) continue;
    visible.unobserve(rig.card);
    rig.card.remove();
    rig.row.remove();
    rigs.delete(name);
  }
  // Where nothing runs, no single rig is to blame.
  const runs = lab.services.some((service) => !service.silent);
  const cards = at("cards"), rows = at("rows").querySelector("tbody");
  for (const known of lab.rigs) {
    let rig = rigs.get(known.rig);
    if (!rig) {
      rigs.set(known.rig, rig = new Rig(known.rig));
      cards.append(rig.card);
      rows.append(rig.row);
      visible.observe(rig.card);
    }
    rig.update(known, runs);
  }
  const alarms = [...rigs.values()].filter((rig) => rig.level === "bad").length;
  const sums = [[rigs.size, rigs.size === 1 ? "rig" : "rigs"], [lab.rigs.filter((rig) => rig.controller).length, "in use"],
    [lab.rigs.filter((rig) => rig.recording).length, "recorded"]];
  if (alarms) sums.push([alarms, alarms === 1 ? "alarm" : "alarms"]);
  at("sums").replaceChildren(...sums.map(([number, what]) =>
    made("li", what.startsWith("alarm") ? {class: "alarm"} : {}, made("b", {}, String(number)), ` ${what}`)));
  const troubles = lab.alerts.map((text) => ["warn", text]);
  if (lab.link) troubles.unshift(["bad", lab.link]);
  else if (!runs) {
    troubles.unshift(["bad", `Nothing is heard of the lab “${lab.lab}”: is it running (hilrig up), with this lab.toml?`]);
  }
  const list = at("troubles"), before = [...list.children].map((item) => item.textContent).join("\n");
  if (before !== troubles.map(([, text]) => text).join("\n")) {
    list.replaceChildren(...troubles.map(([level, text]) => made("li", {"data-level": level}, text)));
  }
  showServices(lab.services);
  arrange();
  if (lab.scenes !== scenesWanted) fetchScenes(lab.scenes);
  if (lab.runs !== runsShown) fetchRuns(lab.runs);
}

function showServices(services) {
  const table = at("services");
  at("services-none").hidden = services.length > 0;
  table.parentElement.hidden = services.length === 0;
  table.tBodies[0].replaceChildren(...services.map((service) => {
    const cells = [service.host, service.rigs, service.cpu_percent.toFixed(0), service.memory_mib.toFixed(0),
      service.lateness_p99_ms.toFixed(2), service.overruns, service.lost_transport + service.lost_recorder,
      service.clock_peer ? `${service.clock_offset_ms < 0 ? "−" : "+"}${Math.abs(service.clock_offset_ms).toFixed(1)} ± ${service.clock_uncertainty_ms.toFixed(1)}` : "–"];
    const row = made("tr", service.silent || service.alert ? {"data-level": "bad"} : {},
      made("th", {scope: "row"}, `${service.service}/${service.instance}${service.silent ? " (silent)" : ""}`));
    row.append(...cells.map((cell, number) => made("td", number ? {class: "n"} : {}, String(cell))));
    return row;
  }));
}

function arrange() {
  const words = at("words").value.toLowerCase().split(/\s+/).filter(Boolean), which = at("which").value;
  let shown = 0;
  for (const rig of rigs.values()) {
    const hidden = !rig.matches(words, which);
    shown += hidden ? 0 : 1;
    if (rig.card.hidden !== hidden) rig.card.hidden = rig.row.hidden = hidden;
  }
  const none = at("rigs-none");
  none.hidden = shown > 0;
  say(none, rigs.size ? "No rig is like that." : "No rig is known.");
  const asTable = (chosenView || (rigs.size > CARDS_AT_MOST ? "table" : "cards")) === "table";
  at("cards").hidden = asTable;
  at("rows").hidden = !asTable || shown === 0;
  at("as-cards").setAttribute("aria-pressed", String(!asTable));
  at("as-table").setAttribute("aria-pressed", String(asTable));
}

// They are sent when they change; what was not to be drawn then is drawn when it is.
function showPoses(newest) {
  poses = newest;
  for (const rig of rigs.values()) {
    const pose = poses[rig.name], scene = pose && scenes[pose[0]];
    if (!scene) rig.arm.lost();
    else if (rig.arm.seen || !rig.arm.scene) rig.arm.take(scene, pose[1], pose[2]);
  }
  if (!gliding) {
    gliding = true;
    requestAnimationFrame(glide);
  }
}

function glide(now) {
  gliding = false;
  for (const rig of rigs.values()) {
    const arm = rig.arm;
    if (arm.wanted && (arm.seen || !arm.shown) && arm.shown !== arm.wanted) {
      if (arm.glide(now)) gliding = true;
      else arm.shown = arm.wanted;
    }
  }
  if (gliding) requestAnimationFrame(glide);
}

function showEvent(event) {
  const list = at("events"), when = new Date(event.wall_ms);
  const item = made("li", {"data-level": SEVERITIES[event.severity] ?? "warn"},
    made("time", {datetime: when.toISOString(), title: when.toLocaleString()}, when.toLocaleTimeString()),
    made("span", {}, made("b", {}, event.rig || event.source), ` ${event.text}`));
  list.prepend(item);
  while (list.children.length > EVENTS_KEPT) list.lastElementChild.remove();
  at("events-none").hidden = true;
}

function lengthOf(seconds) {
  if (seconds < 60) return `${seconds.toFixed(1)} s`;
  const whole = Math.round(seconds), two = (number) => String(number).padStart(2, "0");
  const minutes = Math.floor(whole / 60);
  return minutes < 60 ? `${minutes}:${two(whole % 60)}` : `${Math.floor(minutes / 60)}:${two(minutes % 60)}:${two(whole % 60)}`;
}

function sizeOf(bytes) {
  for (const unit of ["B", "KiB", "MiB"]) {
    if (bytes < 1024) return `${bytes.toFixed(unit === "MiB" ? 1 : 0)} ${unit}`;
    bytes /= 1024;
  }
  return `${bytes.toFixed(1)} GiB`;
}

function showRuns(list) {
  const table = at("runs");
  table.parentElement.hidden = list.runs.length === 0;
  const more = list.found > list.runs.length ? `, the newest ${list.runs.length} shown` : "";
  say(at("runs-count"), list.trouble || (list.found === list.total ? `${list.total}${more}` : `${list.found} of ${list.total}${more}`));
  table.tBodies[0].replaceChildren(...list.runs.map((run) => {
    const begun = run.start_ms ? new Date(run.start_ms).toLocaleString() : run.name;
    const row = made("tr", run.trouble ? {"data-level": "bad"} : {}, made("th", {scope: "row", title: run.path}, begun),
      made("td", {}, run.rig));
    const links = made("td");
    if (!run.open && !run.trouble) {
      links.append(made("a", {href: `reports/${pathOf(run.path)}`, target: "_blank", rel: "noopener",
        "aria-label": `Report of ${run.name}`}, "Report"));
    }
    if (!run.open) links.append(made("a", {href: `recordings/${pathOf(run.path)}`, download: "", "aria-label": `Recording ${run.name}`}, "MCAP"));
    if (run.trouble) {
      row.append(made("td", {class: "long", colspan: "8"}, run.trouble), links);
      return row;
    }
    const lost = run.lost_transport + run.lost_recorder + run.lost_file;
    const fit = made("td", run.fit === null ? {} : {class: run.fit ? "good" : "bad", title: run.unfit}, run.fit === null ? "–" : run.fit ? "yes" : "no");
    const figures = [run.open ? "–" : lengthOf(run.duration_s), sizeOf(run.size), fixed(run.loop_p50_ms, 1), fixed(run.loop_p99_ms, 1)];
    row.append(made("td", {}, run.controller || "nobody"), ...figures.map((text) => made("td", {class: "n"}, text)),
      made("td", {class: lost ? "n bad" : "n"}, String(lost)), fit, made("td", {title: run.reason}, run.open ? "being written" : run.ended), links);
    return row;
  }));
}

// ---- what is fetched

async function fetchScenes(wanted) {
  scenesWanted = wanted;
  try {
    scenes = await (await fetch("scenes")).json();
    showPoses(poses);
  } catch {
    scenesWanted = -1;
  }
}

async function fetchRuns(version) {
  runsShown = version;
  const words = at("run-words").value;
  try {
    const list = await (await fetch(`runs?words=${encodeURIComponent(words)}`)).json();
    if (words === at("run-words").value) showRuns(list);
  } catch {
    runsShown = -1;
  }
}

function listen() {
  const source = new EventSource("live");
  const told = (name, show) => source.addEventListener(name, (message) => show(JSON.parse(message.data)));
  source.onopen = () => {
    // It may be another run of the console: its numbers mean something else.
    scenesWanted = runsShown = -1;
  };
  source.onerror = () => {
    heardMs = 0;
    look();
    if (source.readyState === EventSource.CLOSED) setTimeout(listen, 3000);
  };
  told("lab", showLab);
  told("poses", showPoses);
  told("event", showEvent);
}

function look() {
  const link = at("link"), live = Date.now() - heardMs < QUIET_MS;
  mark(link, live ? "good" : "bad");
  say(link, live ? "live" : "no connection to the console");
  document.body.classList.toggle("cut", !live);
  if (!live) for (const rig of rigs.values()) rig.arm.lost();
}

function remember() {
  for (const [key, value] of [["rigs", at("words").value], ["which", at("which").value === "all" ? "" : at("which").value], ["view", chosenView]]) {
    if (value) place.set(key, value);
    else place.delete(key);
  }
  history.replaceState(null, "", place.size ? `#${place}` : location.pathname);
  arrange();
}

at("words").value = place.get("rigs") || "";
if (["held", "alarm"].includes(place.get("which"))) at("which").value = place.get("which");
chosenView = ["cards", "table"].includes(place.get("view")) ? place.get("view") : "";
at("words").addEventListener("input", remember);
at("which").addEventListener("change", remember);
for (const view of ["cards", "table"]) at(`as-${view}`).addEventListener("click", () => { chosenView = view; remember(); });
let pause = 0;
at("run-words").addEventListener("input", () => { clearTimeout(pause); pause = setTimeout(() => fetchRuns(runsShown), 200); });
setInterval(look, 1000);
listen();
