// Puts the page together: messages in, one picture of them out.

import { nowMs } from "./clock.js";
import { onColours } from "./colours.js";
import { Commands } from "./commands.js";
import { byId, setData, setHidden, setText } from "./dom.js";
import { EventList } from "./events.js";
import { judge } from "./verdict.js";
import { Link, takeToken } from "./link.js";
import { ControlDetails, Figures, Lights, PreflightList } from "./panels.js";
import { Plots } from "./plots.js";
import { Replay } from "./replay.js";
import { SceneView } from "./scene.js";
import { TopBar } from "./topbar.js";
import { Vehicle } from "./vehicle.js";

const LOOK_MS = 100; // how often staleness is looked for, whatever comes or does not come
const SCENE_MS = 45;
const PLOTS_MS = 200;
const DUMB_S = 5; // a connection over which a flying vehicle is not heard for so long is made anew ...
const RENEW_MS = 10_000; // ... but not more often than this

const vehicles = new Map();
let chosen = null;
let hello = null;
let broker = null;
let everOpen = false;
let replay = null;
let notice = null;
let renewedMs = nowMs();
let sceneDueMs = 0;
let plotsDueMs = 0;
let dirty = { scene: true, plots: true };
let shownName = null;
let frameAsked = false;

const link = new Link(takeToken(), hear, () => {
  everOpen ||= link.open;
  if (!link.open) broker = null;
  look();
});
const topBar = new TopBar((name) => {
  chosen = name;
  refresh();
});
const figures = new Figures(byId("figures"));
const sceneView = new SceneView(byId("scene"), document.querySelector(".presets"), () => refresh());
const plots = new Plots(byId("plots"), () => refresh());
const lights = new Lights(byId("light-list"));
const preflight = new PreflightList();
const details = new ControlDetails();
const eventList = new EventList();
const commands = new Commands((message) => link.send(message), nowMs);

function hear(message) {
  const { kind } = message;
  if (kind === "hello") welcome(message);
  else if (kind === "broker") broker = message;
  else if (kind === "sent" || kind === "refused" || kind === "ack") commands.hear(message);
  else if (typeof message.vehicle === "string" && message.data) vehicleOf(message.vehicle).take(kind, message.data, nowMs(), message.age_s);
  if (kind === "stream") {
    if (message.vehicle === current()?.name) {
      dirty.scene = dirty.plots = true;
      ask();
    }
  } else {
    refresh();
  }
}

function welcome(message) {
  hello = message;
  if (message.replay && replay === null) {
    replay = new Replay(message.logs ?? [], refresh, (text) => {
      notice = text;
    });
  }
}

function vehicleOf(name) {
  if (!vehicles.has(name)) vehicles.set(name, new Vehicle(name));
  return vehicles.get(name);
}

/** The vehicle that is shown: the chosen one, else the first that is there, else the first. */
function current() {
  if (replay !== null) return replay.vehicle;
  if (chosen !== null && vehicles.has(chosen)) return vehicles.get(chosen);
  const all = [...vehicles.values()];
  const here = all.find((vehicle) => vehicle.stream !== null && vehicle.state?.presence !== "ended");
  chosen = here?.name ?? null; // it stays, whoever comes and goes
  return here ?? all[0] ?? null;
}

const linkNow = () => ({ open: link.open, everOpen, broker: replay === null ? broker : null });

/** Everything but the canvases; at least every 100 ms. */
function look() {
  const now = nowMs();
  const vehicle = current();
  const state = linkNow();
  const verdict = judge(vehicle, replay === null ? state : { open: true, broker: null }, now);
  if (vehicle?.name !== shownName) {
    shownName = vehicle?.name;
    lights.clear();
  }
  const others = new Map(replay === null ? [...vehicles].map(([name, one]) => [name, one === vehicle ? verdict : judge(one, state, now)]) : []);
  topBar.draw({ vehicle, verdict, hello, others, replayName: replay?.name });
  figures.draw(vehicle);
  lights.draw(vehicle);
  preflight.draw(vehicle);
  details.draw(vehicle);
  eventList.draw(vehicle);
  commands.draw({ canCommand: Boolean(hello?.can_command), whyNot: hello === null ? "not connected yet" : hello.why_not, vehicle, verdict });
  setText(byId("operator"), hello?.operator && hello.can_command ? `as ${hello.operator}` : "");
  const trouble = link.open && broker?.connected !== false ? troubleElsewhere(vehicle, others) : null;
  setData(byId("notice"), "level", trouble === null ? "" : "bad");
  const said = notice ?? trouble ?? (broker?.rubbish ? `${broker.rubbish} messages on the broker were none of ours and were thrown away (${broker.rubbish_text ?? ""})` : null);
  setHidden(byId("notice"), said === null);
  setText(byId("notice"), said ?? "");
  if (link.open && broker?.connected && verdict.presence === "flying" && verdict.ageS > DUMB_S && now - renewedMs > RENEW_MS) {
    renewedMs = now;
    link.renew();
  }
}

/** Vehicles that are not shown and not well; null: none. */
function troubleElsewhere(shown, others) {
  const bad = [...others].filter(([name, verdict]) => name !== shown?.name && (verdict.level === "bad" || verdict.stale));
  return bad.map(([name, { banner, word, why }]) => `${name}: ${banner?.word ?? word}, ${banner?.text ?? why}`).join(" · ") || null;
}

/** Draw everything anew, soon. */
function refresh() {
  dirty = { scene: true, plots: true };
  sceneDueMs = plotsDueMs = 0;
  look();
  ask();
}

function ask() {
  if (frameAsked) return;
  frameAsked = true;
  requestAnimationFrame(paint);
}

function paint() {
  frameAsked = false;
  const now = nowMs();
  const vehicle = current();
  if (dirty.scene && now >= sceneDueMs) {
    dirty.scene = false;
    sceneDueMs = now + SCENE_MS;
    sceneView.draw(vehicle);
  }
  if (dirty.plots && now >= plotsDueMs) {
    dirty.plots = false;
    plotsDueMs = now + PLOTS_MS;
    plots.draw(vehicle);
  }
}

setInterval(() => {
  look();
  if (dirty.scene || dirty.plots) ask();
}, LOOK_MS);
document.addEventListener("visibilitychange", refresh);
const sizes = new ResizeObserver(refresh);
for (const canvas of document.querySelectorAll("canvas")) sizes.observe(canvas);
onColours(refresh);
byId("control").addEventListener("toggle", look);
look();
