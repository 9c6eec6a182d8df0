// The top bar: status, staleness banner, choice of vehicle.

import { byId, make, setData, setHidden, setText } from "./dom.js";
import { age, clockTime, fixed, NOTHING, readable } from "./format.js";

export class TopBar {
  constructor(onPick) {
    byId("vehicle-select").addEventListener("change", (event) => onPick(event.target.value));
  }

  /** @param page {vehicle, verdict, hello, others: Map of name -> verdict, replayName} */
  draw({ vehicle, verdict, hello, others, replayName }) {
    const { body } = document;
    const old = verdict.stale;
    setData(body, "level", old ? "unknown" : verdict.level);
    setData(body, "stale", String(old));
    setData(body, "frame", old || verdict.level === "bad" ? "bad" : "");
    setData(body, "old", String(old || verdict.ended));
    setData(body, "presence", verdict.presence);
    setText(byId("word"), verdict.word);
    setText(byId("why"), verdict.why);
    this._banner(verdict);
    this._age(verdict, Boolean(hello?.replay));
    this._who(vehicle, others, hello, replayName);
    this._course(vehicle);
    const title = `${verdict.banner?.word ?? verdict.word} · ${vehicle?.name ?? "companion"}`;
    if (document.title !== title) document.title = title;
  }

  _banner({ banner, ageS }) {
    setHidden(byId("stale"), banner === null);
    setText(byId("stale-word"), banner?.word ?? "");
    setText(byId("stale-age"), banner === null || ageS === null ? "" : age(ageS));
    setText(byId("stale-text"), banner?.text ?? "");
  }

  _age({ ageS, ended }, replay) {
    const element = byId("age");
    setHidden(byId("age-label").parentElement, replay);
    setText(element, ended || ageS === null ? NOTHING : age(ageS));
    setData(element, "age", ageS === null ? "" : ageS.toFixed(3));
  }

  _who(vehicle, others, hello, replayName) {
    const several = others.size > 1;
    setHidden(byId("pick"), !several);
    setHidden(byId("vehicle-name"), several);
    setText(byId("vehicle-name"), vehicle ? vehicle.name : "no vehicle yet");
    if (several) this._options(vehicle, others);
    setHidden(byId("badge-simulation"), !vehicle?.state?.simulated);
    setHidden(byId("badge-replay"), !hello?.replay);
    setHidden(byId("badge-view"), hello === null || hello.replay || hello.can_command);
    const about = vehicle?.state;
    setText(byId("mission"), [about ? `${about.mission}: ${about.law}, ${about.preset}` : NOTHING, replayName].filter(Boolean).join(" · "));
  }

  _options(vehicle, others) {
    const select = byId("vehicle-select");
    const names = [...others.keys()];
    if ([...select.options].map((option) => option.value).join("\n") !== names.join("\n")) {
      select.replaceChildren(...names.map((name) => {
        const option = make("option");
        option.value = name;
        return option;
      }));
    }
    for (const option of select.options) {
      const verdict = others.get(option.value);
      const label = `${verdict.level === "bad" || verdict.stale ? "⚠ " : ""}${option.value} · ${verdict.banner?.word ?? verdict.word}`;
      if (option.textContent !== label) option.textContent = label;
    }
    if (vehicle && select.value !== vehicle.name) select.value = vehicle.name;
  }

  _course(vehicle) {
    const stream = vehicle?.stream ?? null;
    setText(byId("phase"), stream ? readable(stream.phase) : NOTHING);
    const planned = vehicle?.scene?.mission_s;
    setText(byId("mission-time"), stream ? `${clockTime(stream.mission_t_s)}${planned ? ` of ${clockTime(planned)}` : ""}` : NOTHING);
    const progress = byId("progress");
    const value = stream ? Math.max(0, Math.min(1, stream.progress)) : 0;
    if (Math.abs(progress.value - value) > 1e-3) progress.value = value;
    const spoken = `${fixed(value * 100, 0)} %`;
    if (progress.title !== spoken) progress.title = spoken;
  }
}
