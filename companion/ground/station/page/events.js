// The list of events, newest first; screen readers announce new ones.

import { byId, make, setData, setHidden, setText } from "./dom.js";
import { fixed, readable } from "./format.js";

const RANK = { info: 0, warning: 1, critical: 2 };

export class EventList {
  constructor() {
    this._least = "info";
    this._rows = [];
    this._key = null;
    this._announced = -1;
    this._filters = [...document.querySelectorAll("[data-filter]")];
    for (const button of this._filters) button.addEventListener("click", () => this._filter(button.dataset.filter));
  }

  _filter(least) {
    this._least = least;
    for (const button of this._filters) button.setAttribute("aria-pressed", String(button.dataset.filter === least));
    for (const row of this._rows) setHidden(row.element, RANK[row.line.severity] < RANK[least]);
    this._count();
  }

  draw(vehicle) {
    const lines = vehicle?.eventLines() ?? [];
    const session = vehicle?.events?.session ?? "";
    const key = `${vehicle?.name}/${session}/${vehicle?.replayed}`;
    const newest = lines.at(-1)?.number ?? -1;
    const known = this._rows[0]?.line.number ?? -1;
    const other = key !== this._key;
    if (other || newest < known) this._clear();
    if (other) this._announced = newest;
    this._key = key;
    const from = this._rows[0]?.line.number ?? -1;
    const fresh = lines.filter((line) => line.number > from);
    if (fresh.length === 0 && !other) return;
    for (const line of fresh) this._add(line);
    while (this._rows.length > 200) this._rows.pop().element.remove();
    this._announce(fresh, vehicle?.replayed);
    this._count();
  }

  _clear() {
    this._rows = [];
    byId("event-list").replaceChildren();
  }

  _add(line) {
    const text = make("span", { className: "text", text: line.text });
    text.append(make("span", { className: "id", text: line.id }));
    const element = make("li", {
      data: { severity: line.severity, event: line.id },
      children: [make("time", { text: `${fixed(line.mission_t_s, 1)} s` }), text, make("span", { className: "action", text: line.action === "nominal" ? "" : readable(line.action) })],
    });
    element.hidden = RANK[line.severity] < RANK[this._least];
    byId("event-list").prepend(element);
    this._rows.unshift({ line, element });
  }

  _count() {
    const shown = this._rows.filter((row) => !row.element.hidden).length;
    setText(byId("events-count"), this._rows.length === shown ? `${shown}` : `${shown} of ${this._rows.length}`);
    setHidden(byId("event-none"), shown > 0);
    setText(byId("event-none"), this._rows.length === 0 ? "No events yet." : "No events of this severity.");
    setHidden(byId("event-list"), shown === 0);
  }

  _announce(fresh, replayed) {
    const unannounced = fresh.filter((line) => line.number > this._announced);
    if (unannounced.length === 0 || replayed) return;
    this._announced = unannounced.at(-1).number;
    const region = byId("announce");
    setData(region, "last", unannounced.at(-1).id);
    setText(region, unannounced.slice(-3).map((line) => (line.severity === "info" ? line.text : `${line.severity}: ${line.text}`)).join(". "));
  }
}
