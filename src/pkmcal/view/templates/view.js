"use strict";
// The page knows no camera: every place in a picture comes from the program, also while one pulls.
const $ = (id) => document.getElementById(id);
const state = JSON.parse($("state").textContent);
const SVG = "http://www.w3.org/2000/svg";
const STEP = 1.05; // the distance's change by one notch of the wheel, or one press
const NOTCH = 100; // what browsers call one notch
const ENOUGH = 2; // joints put to their places, after which the machine snaps to the images
const PAUSE = 250; // ms without a turn of the wheel after which the next is another one

const here = { s: 0, k: 0, shown: "nominal", kind: "aim" };
// By station: the pose (null for the files' own), those before it, joints put to their places.
const stations = state.stations.map(() => ({ pose: null, before: [], pins: [], changed: false }));
let epoch = 0; // answers about an image that is not shown any more are let go
const timings = []; // ms from a move of the mouse to the overlay that it asked for
const held = () => here.shown === "calibration";
const mine = () => stations[here.s];

// ---------------------------------------------------------------- state

function node(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

document.title = `${state.name}, images`;
$("name").textContent = state.name;
$("machines").hidden = !state.calibrated;
state.stations.forEach((station, s) => {
  const heading = node("h2", {}, station.name);
  if (station.handheld) heading.append(" ", node("span", { class: "small" }, "by hand"));
  document.querySelector(".list").append(heading, node("ol", {}, ...station.images.map((image, k) =>
    node("li", {}, node("button", { type: "button", "data-station": s, "data-image": k }, image)))));
});
for (let leg = 1; leg <= state.legs; leg += 1) {
  $("legs").append(node("li", {}, node("span", { class: `chip photo leg-${(leg - 1) % 8 + 1}` }, `${leg}`), " ",
    node("span", { class: "small", "data-leg": leg })));
}

// ---------------------------------------------------------------- asking

async function post(what, body) {
  let answer;
  try {
    const response = await fetch(what, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
    answer = await response.json();
  } catch {
    answer = { message: "pkmcal view has ended, or does not answer. Start it again." };
  }
  if (answer.message) { say(answer.message, "bad"); return null; }
  return answer;
}

function request(more) {
  const pose = held() ? null : mine().pose;
  return { station: here.s, image: here.k, shown: here.shown, pose, ...more };
}

// Of moves that come faster than answers, the latest wins.
let waiting = null, asking = null;
function overlay(more = {}) {
  waiting = { body: request(more), epoch, moved: performance.now() };
  asking ??= (async () => {
    while (waiting) {
      const one = waiting;
      waiting = null;
      const answer = await post("overlay", one.body);
      if (answer && one.epoch === epoch) {
        draw(answer);
        timings.push(performance.now() - one.moved);
      }
    }
    asking = null;
  })();
  return asking;
}

let finding = 0;
async function find() {
  const now = epoch;
  finding += 1;
  const answer = await post("found", request({}));
  finding -= 1;
  if (answer && now === epoch) show(answer);
}

// ---------------------------------------------------------------- drawing

function element(name, attributes, parent, tip) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (tip) made.appendChild(document.createElementNS(SVG, "title")).textContent = tip;
  return parent.appendChild(made);
}
const colour = (leg) => `leg-${(leg - 1) % 8 + 1}`;

function draw(answer) {
  if (!held()) mine().pose = answer.pose;
  const laid = $("laid"), joints = $("joints"), size = state.stations[here.s].size[0];
  laid.replaceChildren();
  for (const leg of answer.legs) element("path", { class: "halo", d: leg.d }, laid);
  for (const leg of answer.legs) element("path", { class: `edge ${colour(leg.leg)}${leg.quiet ? " axis" : ""}`, d: leg.d }, laid);
  joints.replaceChildren();
  for (const joint of answer.joints) {
    const pinned = mine().pins.some((p) => p.image === here.k && p.end === joint.end && p.leg === joint.leg);
    const at = { cx: joint.x, cy: joint.y }, group = element("g", { class: colour(joint.leg) }, joints);
    element("circle", { ...at, r: size / 110, class: "halo" }, group);
    element("circle", { ...at, r: size / 110, class: `ring${pinned && !held() ? " pinned" : ""}` }, group);
    if (joint.number) element("text", { x: joint.x + size / 80, y: joint.y + size / 45, "font-size": size / 45 }, group).textContent = joint.leg;
    const hit = element("circle", { ...at, r: size / 55, class: "hit" }, group, `Leg ${joint.leg}, ${joint.end} joint`);
    hit.dataset.end = joint.end;
    hit.dataset.leg = joint.leg;
  }
  for (const cell of document.querySelectorAll("#place dd")) cell.textContent = `[${answer.place[cell.dataset.part].join(", ")}]`;
  const station = state.stations[here.s];
  $("from").textContent = held() ? "As the calibration found it." : mine().changed ? "Not written yet."
    : station.handheld ? "A camera held by hand has no one pose in session.yaml." : station.posed ? "As session.yaml has it." : "session.yaml has none; this is a guess to begin with.";
  $("undo").disabled = held() || !mine().before.length;
  $("save").disabled = held() || station.handheld || !mine().changed;
}

function show(answer) {
  for (const id of ["found", "missed", "corners"]) $(id).replaceChildren();
  for (const edge of answer.missed) element("path", { class: `lost ${colour(edge.leg)}`, d: edge.d }, $("missed"), edge.tip);
  for (const edge of answer.edges) element("path", { class: `seen${edge.quiet ? " quiet" : ""}`, d: edge.d }, $("found"), edge.tip);
  const size = state.stations[here.s].size[0] / 160;
  for (const [x, y] of answer.corners) element("path", { class: "corner", d: `M${x - size},${y}H${x + size}M${x},${y - size}V${y + size}` }, $("corners"));
  const lines = (texts, kind) => texts.map((text) => Object.assign(document.createElement(kind), { textContent: text }));
  $("told").replaceChildren(...lines(answer.told, "p"));
  for (const cell of document.querySelectorAll("#legs [data-leg]")) {
    const of = (edges) => edges.filter((edge) => edge.leg === +cell.dataset.leg).length;
    const seen = of(answer.edges), all = seen + of(answer.missed);
    cell.textContent = all ? `${seen} of ${all}` : "–";
  }
  const reasons = new Map();
  for (const edge of answer.missed) reasons.set(edge.reason, [...(reasons.get(edge.reason) ?? []), edge.leg]);
  const named = (legs) => legs.length === 1 ? `leg ${legs[0]}` : `legs ${legs.slice(0, -1).join(", ")} and ${legs.at(-1)}`;
  const list = lines([...reasons].map(([why, legs]) => `${legs.length === 1 ? "An edge" : `${legs.length} edges`} of ${named([...new Set(legs)])}: ${why}.`), "li");
  const ul = document.createElement("ul");
  ul.append(...list);
  $("reasons").replaceChildren(...(list.length ? [ul] : []));
}

function say(text, kind = "") {
  $("said").textContent = text;
  $("said").className = `note ${kind}`;
  $("said").hidden = !text;
}

// ---------------------------------------------------------------- walking

function go(s, k, shown = here.shown) {
  const station = state.stations[s];
  if (!station || !station.images[k]) return;
  Object.assign(here, { s, k, shown });
  epoch += 1;
  say("");
  const [width, height] = station.size, picture = $("image"), name = station.images[k];
  $("shot").setAttribute("viewBox", `-0.5 -0.5 ${width} ${height}`);
  $("shot").style.setProperty("--ratio", width / height);
  $("shot").classList.toggle("held", held());
  picture.setAttribute("width", width);
  picture.setAttribute("height", height);
  picture.setAttribute("href", `image/${s}/${k}`);
  for (const id of ["laid", "found", "missed", "corners", "joints"]) $(id).replaceChildren();
  $("where").textContent = `${station.name} / ${name}`;
  for (const button of document.querySelectorAll(".list button")) {
    const current = +button.dataset.station === s && +button.dataset.image === k;
    button.toggleAttribute("aria-current", current);
    if (current) { button.setAttribute("aria-current", "true"); button.scrollIntoView({ block: "nearest", inline: "nearest" }); }
  }
  for (const button of document.querySelectorAll("[data-shown]")) button.setAttribute("aria-pressed", button.dataset.shown === shown);
  for (const id of ["tools", "how", "keep"]) $(id).hidden = held();
  for (const id of ["fit", "anywhere"]) $(id).disabled = held() || !station.legs;
  history.replaceState(null, "", `#${s + 1}/${k + 1}/${shown}`);
  overlay().then(find);
}

function walk(step) {
  const count = state.stations.map((station) => station.images.length);
  let { s, k } = here;
  k += step;
  if (k < 0) { s -= 1; k = (count[s] ?? 0) - 1; }
  if (k >= count[s]) { s += 1; k = 0; }
  go(s, k);
}

// A picture that does not come has its reason in words.
$("image").addEventListener("error", async () => {
  const answer = await fetch($("image").getAttribute("href")).then((r) => r.json()).catch(() => null);
  say(answer?.message ?? "The image does not come.", "bad");
});
$("image").addEventListener("load", () => { document.documentElement.dataset.picture ??= Math.round(performance.now()); });

// ---------------------------------------------------------------- moving

function remember() {
  mine().before.push({ pose: mine().pose, pins: mine().pins, changed: mine().changed });
  mine().changed = true;
  epoch += 1; // what was asked of the pose before is of no use
}
function undo() {
  const last = mine().before.pop();
  if (!last || held()) return;
  Object.assign(mine(), last);
  epoch += 1;
  say("");
  overlay().then(find);
}
function pixel(event) {
  const point = new DOMPoint(event.clientX, event.clientY).matrixTransform($("shot").getScreenCTM().inverse());
  return [point.x, point.y];
}

let pull = null;
$("shot").addEventListener("pointerdown", (event) => {
  if (held() || event.button !== 0) return;
  event.preventDefault();
  const joint = event.target.dataset?.end ? { end: event.target.dataset.end, leg: +event.target.dataset.leg } : null;
  const kind = event.shiftKey ? "turn" : event.altKey ? "roll" : here.kind;
  remember();
  const others = mine().pins.filter((p) => !(joint && p.image === here.k && p.end === joint.end && p.leg === joint.leg));
  pull = { joint: kind === "aim" ? joint : null, kind, start: pixel(event), pose: mine().pose, others, moved: false };
  $("shot").setPointerCapture(event.pointerId);
  $("shot").classList.add("pulling");
});
$("shot").addEventListener("pointermove", (event) => {
  if (!pull) return;
  pull.moved = true;
  const end = pixel(event);
  mine().pins = pull.joint ? [...pull.others, { ...pull.joint, image: here.k, pixel: end }] : [];
  overlay({ pose: pull.pose, ...(pull.joint ? { pins: mine().pins } : { gesture: { kind: pull.kind, start: pull.start, end } }) });
});
async function release() {
  if (!pull) return;
  const done = pull;
  pull = null;
  $("shot").classList.remove("pulling");
  if (!done.moved) { Object.assign(mine(), mine().before.pop()); overlay().then(find); return; }
  await asking;
  say("");
  // two joints tell the place well enough for the machine to be recognised there
  if (done.joint && mine().pins.length >= ENOUGH) fit(false);
  else find();
}
$("shot").addEventListener("pointerup", release);
$("shot").addEventListener("pointercancel", release);

let wheel = null;
function distance(factor, at) {
  if (held()) return;
  if (!wheel) { remember(); mine().pins = []; wheel = { pose: mine().pose, factor: 1 }; }
  wheel.factor *= factor;
  clearTimeout(wheel.timer);
  wheel.timer = setTimeout(async () => { wheel = null; await asking; find(); }, PAUSE);
  overlay({ pose: wheel.pose, gesture: { kind: "distance", start: at, end: at, factor: wheel.factor } });
}
$("shot").addEventListener("wheel", (event) => {
  if (held()) return;
  event.preventDefault();
  distance(STEP ** (event.deltaY / NOTCH), pixel(event));
}, { passive: false });
const middle = () => state.stations[here.s].size.map((length) => (length - 1) / 2);
$("nearer").addEventListener("click", () => distance(1 / STEP, middle()));
$("farther").addEventListener("click", () => distance(STEP, middle()));

async function fit(anywhere) {
  if ($("fit").disabled) { find(); return; }
  await asking;
  const now = epoch;
  finding += 1;
  say("Looking for the machine …");
  for (const id of ["fit", "anywhere"]) $(id).disabled = true;
  const answer = await post("fit", request({ anywhere }));
  finding -= 1;
  for (const id of ["fit", "anywhere"]) $(id).disabled = held() || !state.stations[here.s].legs;
  if (!answer || now !== epoch) return;
  say(answer.said, answer.recognised ? "good" : "bad");
  if (answer.recognised) { remember(); mine().pins = []; draw(answer); }
  find();
}
async function save() {
  if ($("save").disabled) return;
  await asking;
  const station = mine(), answer = await post("save", request({}));
  if (!answer) return;
  station.changed = false;
  state.stations[here.s].posed = true;
  say(answer.said, "good");
  $("from").textContent = "As session.yaml has it.";
  $("save").disabled = true;
}

// ---------------------------------------------------------------- controls

document.querySelector(".list").addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (button) go(+button.dataset.station, +button.dataset.image);
});
for (const button of document.querySelectorAll("[data-shown]")) button.addEventListener("click", () => go(here.s, here.k, button.dataset.shown));
for (const button of document.querySelectorAll("[data-kind]")) {
  button.addEventListener("click", () => {
    here.kind = button.dataset.kind;
    for (const other of document.querySelectorAll("[data-kind]")) other.setAttribute("aria-pressed", other === button);
  });
}
$("before").addEventListener("click", () => walk(-1));
$("next").addEventListener("click", () => walk(1));
$("undo").addEventListener("click", undo);
$("fit").addEventListener("click", () => fit(false));
$("anywhere").addEventListener("click", () => fit(true));
$("save").addEventListener("click", save);
addEventListener("keydown", (event) => {
  if (event.key.toLowerCase() === "z" && (event.ctrlKey || event.metaKey)) { event.preventDefault(); undo(); return; }
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const act = {
    ArrowLeft: () => walk(-1), ArrowRight: () => walk(1),
    ArrowUp: () => go(here.s - 1, 0), ArrowDown: () => go(here.s + 1, 0), f: () => fit(false),
  }[event.key];
  if (act) { event.preventDefault(); act(); }
});
addEventListener("beforeunload", (event) => { if (stations.some((station) => station.changed)) event.preventDefault(); });

// An address names its image, and a page that is loaded again comes back to it.
const [s0, k0, shown0] = location.hash.slice(1).split("/");
const first = state.stations.findIndex((station) => station.images.length);
if (first < 0) say("The session has no images.", "bad");
else if (state.stations[s0 - 1]?.images[k0 - 1]) go(s0 - 1, k0 - 1, state.calibrated && shown0 === "calibration" ? shown0 : "nominal");
else go(first, 0);
