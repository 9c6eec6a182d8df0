// Both vehicles of a team: verdict, lamps and newest answer of each. A press chooses the one that is displayed and commanded.

import { byId, make, setData, setHidden, setText } from "./dom.js";

export class Team {
  constructor(onPick) {
    this._members = [0, 1].map(() => {
      const [name, aim, word, why, answer, lamps] = ["name", "aim", "word", "why", "answer", "lamps"].map((part) => make("span", { className: part }));
      const button = make("button", { children: [name, aim, word, lamps, why, answer] });
      button.type = "button";
      button.addEventListener("click", () => onPick(button.dataset.vehicle));
      return { button, name, aim, word, why, answer, lamps };
    });
    byId("team").append(...this._members.map((member) => member.button));
  }

  /** @param members [{vehicle, verdict, answer}] of both, the left one first; empty without a team; @param chosen name of the chosen one */
  draw(members, chosen, canCommand) {
    setHidden(byId("team"), members.length === 0);
    setData(document.body, "team", String(members.length > 0));
    members.forEach(({ vehicle, verdict, answer }, index) => {
      const row = this._members[index];
      const { stale, banner } = verdict;
      setData(row.button, "vehicle", vehicle.name);
      setData(row.button, "level", stale ? "bad" : verdict.level);
      setData(row.button, "gone", String(stale || verdict.ended));
      row.button.setAttribute("aria-pressed", String(vehicle.name === chosen));
      setText(row.name, vehicle.name);
      setText(row.aim, vehicle.name !== chosen ? "choose" : canCommand && !verdict.ended ? "commands go here" : "shown");
      setText(row.word, banner?.word ?? verdict.word);
      setText(row.why, banner?.text ?? verdict.why);
      setText(row.answer, answer === undefined ? "" : `${answer.name}: ${answer.text}`);
      setData(row.answer, "state", answer?.state ?? "");
      const lights = vehicle.stream?.lights ?? [];
      if (row.lamps.childElementCount !== lights.length) row.lamps.replaceChildren(...lights.map(() => make("i")));
      lights.forEach((light, number) => {
        setData(row.lamps.children[number], "light", light.light);
        row.lamps.children[number].title = `${light.name}: ${light.text}`;
      });
    });
  }
}
