// Buttons that let something go wrong with the stub, so that a visitor sees what the service does about it.

import { by } from "./panels.js";

const BUTTONS = [
  ["Unplug", "fault", { name: "unplug", seconds: 3 }, "The cable is out for 3 s."],
  ["Dead electrode", "fault", { name: "electrode_open", args: { electrode: 5 }, seconds: 8 }, "The wire of electrode 5 is broken for 8 s."],
  ["Swapped wires", "fault", { name: "electrodes_swapped", args: { electrodes: [2, 3] }, seconds: 8 }, "The wires of electrodes 2 and 3 are exchanged for 8 s."],
  ["Noise", "fault", { name: "missed_interrupt", args: { fraction: 0.1 }, seconds: 5 }, "A tenth of the measurements is wrong for 5 s."],
  ["Line noise", "fault", { name: "line_noise", seconds: 5 }, "Bits flip on the line to the board for 5 s."],
  ["Gain step", "fault", { name: "gain", args: { factor: 1.02 }, seconds: 6 }, "An amplifier's gain jumps by 2 % for 6 s."],
  ["Frozen", "fault", { name: "frozen", seconds: 5 }, "The board sends the same scan again and again for 5 s."],
  ["Drift", "scene", { name: "drift" }, "The sheet dries and electrodes age, over ten minutes; a press a minute."],
  ["All well again", "fault", { clear: true }, "Faults end; so does a scene."],
];

/** command(name, args) -> answer; said(text). */
export function faults(command, said) {
  by("faults").replaceChildren(...BUTTONS.map(([name, what, args, about]) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = name;
    button.title = about;
    button.dataset.fault = args.name ?? "clear";
    button.addEventListener("click", async () => {
      const answer = await command(what, args);
      if (answer.ok && args.clear) await command("release", {});
      said(answer.ok ? about : answer.error);
    });
    return button;
  }));
}
