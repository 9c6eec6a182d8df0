// The page's main module: receives messages and updates all views.

import { nowMs } from "./clock.js";
import { onColours } from "./colours.js";
import { Commands } from "./commands.js";
import { byId, setData, setHidden, setText } from "./dom.js";
import { EventList } from "./events.js";
import { assess } from "./verdict.js";
import { Link, takeToken } from "./link.js";
import { ControlDetails, DeviceList, Figures, PreflightList } from "./panels.js";
import { Plots } from "./plots.js";
import { Replay } from "./replay.js";
import { SceneView } from "./scene.js";
import { Team } from "./team.js";
import { TopBar } from "./topbar.js";
import { Vehicle } from "./vehicle.js";

const UPDATE_MS = 100; // period of updates, which also detect stale data
const SCENE_MS = 45;
const PLOTS_MS = 200;
const SILENT_S = 5; // without data of a flying vehicle for this long the connection is renewed ...
const RENEW_MS = 10_000; // ... but at most once in this time

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
let redraw = { scene: true, plots: true };
let shownName = null;
let paintRequested = false;

const link = new Link(takeToken(), onMessage, () => {
  everOpen ||= link.open;
  if (!link.open) broker = null;
  update();
});
const topBar = new TopBar(choose);
const team = new Team(choose);
const figures = new Figures(byId("figures"));
const sceneView = new SceneView(byId("scene"), document.querySelector(".presets"), () => refresh());
const plots = new Plots(byId("plots"), () => refresh());
const devices = new DeviceList(byId("light-list"));
const preflight = new PreflightList();
const details = new ControlDetails();
const eventList = new EventList();
const commands = new Commands((message) => link.send(message), nowMs);

function onMessage(message) {
  const { kind } = message;
  if (kind === "hello") onHello(message);
  else if (kind === "broker") broker = message;
  else if (kind === "sent" || kind === "refused" || kind === "ack") commands.onMessage(message);
  else if (typeof message.vehicle === "string" && message.data) vehicleOf(message.vehicle).take(kind, message.data, nowMs(), message.age_s);
  if (kind === "stream") {
    const shown = current();
    if (message.vehicle === shown?.name || message.vehicle === partnerOf(shown)?.name) {
      redraw.scene = redraw.plots = true;
      requestPaint();
    }
  } else {
    refresh();
  }
}

function onHello(message) {
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

/** The displayed vehicle: the chosen one, else the first that is present, else the first. */
function current() {
  if (replay !== null) return replay.vehicle;
  if (chosen !== null && vehicles.has(chosen)) return vehicles.get(chosen);
  const all = [...vehicles.values()];
  const here = all.find((vehicle) => vehicle.stream !== null && vehicle.state?.presence !== "ended");
  chosen = here?.name ?? null; // the choice stays when other vehicles appear
  return here ?? all[0] ?? null;
}

function choose(name) {
  chosen = name;
  refresh();
}

/** The other vehicle of a vehicle's team, which each of the two names; else null. */
function partnerOf(vehicle) {
  const partner = vehicles.get(vehicle?.scene?.partner);
  return partner && partner !== vehicle && partner.scene?.partner === vehicle.name ? partner : null;
}

const linkNow = () => ({ open: link.open, everOpen, broker: replay === null ? broker : null });

/** Update everything except the canvases; called at least every 100 ms. */
function update() {
  const now = nowMs();
  const vehicle = current();
  const state = linkNow();
  const verdict = assess(vehicle, replay === null ? state : { open: true, broker: null }, now);
  if (vehicle?.name !== shownName) {
    shownName = vehicle?.name;
    devices.clear();
  }
  const others = new Map(replay === null ? [...vehicles].map(([name, one]) => [name, one === vehicle ? verdict : assess(one, state, now)]) : []);
  const partner = partnerOf(vehicle);
  const members = partner === null ? [] : [vehicle, partner].sort((a, b) => (a.name < b.name ? -1 : 1));
  team.draw(members.map((one) => ({ vehicle: one, verdict: others.get(one.name), answer: commands.newest(one.name) })), vehicle?.name, Boolean(hello?.can_command));
  topBar.draw({ vehicle, verdict, hello, others, replayName: replay?.name });
  figures.draw(vehicle);
  devices.draw(vehicle);
  preflight.draw(vehicle);
  details.draw(vehicle);
  eventList.draw(vehicle);
  commands.draw({ canCommand: Boolean(hello?.can_command), whyNot: hello === null ? "not connected yet" : hello.why_not, vehicle, verdict, named: others.size > 1 });
  setText(byId("operator"), hello?.operator && hello.can_command ? `as ${hello.operator}` : "");
  const problem = link.open && broker?.connected !== false ? otherVehicleProblems(vehicle, others) : null;
  setData(byId("notice"), "level", problem === null ? "" : "bad");
  const text = notice ?? problem ?? (broker?.rejected ? `${broker.rejected} messages on the broker were rejected (${broker.rejected_text ?? ""})` : null);
  setHidden(byId("notice"), text === null);
  setText(byId("notice"), text ?? "");
  if (link.open && broker?.connected && verdict.presence === "flying" && verdict.ageS > SILENT_S && now - renewedMs > RENEW_MS) {
    renewedMs = now;
    link.renew();
  }
}

/** Problems of vehicles that are not displayed; null if there are none. */
function otherVehicleProblems(shown, others) {
  const bad = [...others].filter(([name, verdict]) => name !== shown?.name && (verdict.level === "bad" || verdict.stale));
  return bad.map(([name, { banner, word, why }]) => `${name}: ${banner?.word ?? word}, ${banner?.text ?? why}`).join(" · ") || null;
}

/** Update everything now, and redraw the canvases in the next frame. */
function refresh() {
  redraw = { scene: true, plots: true };
  sceneDueMs = plotsDueMs = 0;
  update();
  requestPaint();
}

function requestPaint() {
  if (paintRequested) return;
  paintRequested = true;
  requestAnimationFrame(paint);
}

function paint() {
  paintRequested = false;
  const now = nowMs();
  const vehicle = current();
  if (redraw.scene && now >= sceneDueMs) {
    redraw.scene = false;
    sceneDueMs = now + SCENE_MS;
    const partner = partnerOf(vehicle);
    const { banner, ended, word } = assess(partner, linkNow(), now);
    sceneView.draw(vehicle, partner, banner?.word ?? (ended ? word : ""));
  }
  if (redraw.plots && now >= plotsDueMs) {
    redraw.plots = false;
    plotsDueMs = now + PLOTS_MS;
    plots.draw(vehicle);
  }
}

setInterval(() => {
  update();
  if (redraw.scene || redraw.plots) requestPaint();
}, UPDATE_MS);
document.addEventListener("visibilitychange", refresh);
const sizes = new ResizeObserver(refresh);
for (const element of [byId("scene"), byId("plots")]) sizes.observe(element);
onColours(refresh);
byId("control").addEventListener("toggle", update);
update();
