/** Page of a machine: the stage, and sliders for its readings. */

import type { Vector3 } from "three";
import type { Configuration, Reading, MachineDocument } from "../document";
import { UNITS, h, number, quantity } from "../dom";
import { legClass } from "../marks";
import { chip, legTable } from "../stage/legs";
import { LAYERS, type Layer, MachineModel } from "../stage/machine";
import { NO_WEBGL, PLANE_VIEW, type Picked, Stage, VIEWS } from "../stage/stage";
import { type Poses, askProgram, sweptPoses } from "./poses";

export function machineView(host: HTMLElement, content: MachineDocument): void {
  const { machine } = content;
  const place = h("div", { class: "stage-host" });
  const status = h("p", { class: "status", role: "status" });
  const platform = platformTable(machine.home);
  const sliders = machine.readings.map((reading, k) => new Slider(reading, k, content));
  let configuration = machine.home;
  let model: MachineModel | null = null;
  let stage: Stage | null = null;

  // the stage, or a sentence in its place
  try {
    stage = new Stage(
      `${machine.name} in space: drag or use the arrow keys to turn, the wheel or + and − to zoom,` +
        " Home to reset",
    );
    place.append(stage.element);
    model = new MachineModel(machine, stage);
  } catch (error) {
    if (stage) throw error;
    place.append(h("p", { class: "box" },
      `${NO_WEBGL} The readings, the platform's position and the legs' values beside are complete.`));
  }

  const show = (next: Configuration): void => {
    configuration = next;
    model?.show(next);
    platform.update(next);
    sliders.forEach((slider, k) => slider.show(next.readings[k], next.beyond.includes(k)));
  };
  const poses: Poses = content.sweeps ? sweptPoses(content.sweeps) : askProgram();
  const move = (k: number, value: number): void => {
    poses(k, value, () => configuration, (answer) => {
      status.textContent = "";
      if ("configuration" in answer && answer.configuration) show(answer.configuration);
      else {
        const { name, unit } = machine.readings[k];
        status.textContent = "message" in answer
          ? answer.message
          : `No pose closes the machine at ${name} = ${quantity(value, unit)}.`;
        sliders[k].refuse(value);
      }
    });
  };
  sliders.forEach((slider, k) => {
    slider.onchange = (value) => move(k, value);
  });

  // legs: hovered on the stage, or chosen in the list
  const legs = legsList(content, (leg) => highlight(leg === null ? null : [leg]));
  let chosen: number[] | null = null;
  const highlight = (which: number[] | null): void => {
    chosen = which;
    model?.highlight(which);
  };
  if (stage) {
    const { onpick } = hovering(stage, content, () => chosen, (which) => model?.highlight(which));
    stage.onpick = onpick;
    stage.ontap = (picked) => legs.choose(picked?.leg ?? null);
  }

  const fit = (direction: Vector3): void => {
    if (model) stage?.fit(model.fitPoints(), direction);
  };
  const first = machine.motion.startsWith("planar") ? PLANE_VIEW : VIEWS["Reset view"];
  const views = Object.entries({ ...VIEWS, "Reset view": first }).map(([name, direction]) =>
    h("button", { type: "button", onclick: () => fit(direction) }, name));
  const layers = layerSwitches(content, (layer, visible) => {
    model?.setLayer(layer, visible);
    if (layer === "cameras") fit(first);
  });

  const same = new Set(machine.readings.map(sense)).size === 1;
  host.append(
    h(
      "header",
      { class: "top" },
      h("p", { class: "kicker" }, content.program),
      h("h1", {}, content.title),
      h("p", { class: "small" }, content.subtitle),
      ...content.notes.map((note) => h("p", { class: "small warn" }, note)),
    ),
    h(
      "main",
      { class: "machine" },
      h(
        "section",
        { class: "space", "aria-label": "Machine in space" },
        place,
        ...(model ? [h("div", { class: "bar" }, ...views, layers)] : []),
        ...(model
          ? [h("p", { class: "small" }, `Lines of the ground every ${number(model.gridStep * 1e3, 0)} mm.`
              + " Arrows marked + point where a reading grows; a ring marked 0 is where it is zero.")]
          : []),
      ),
      h(
        "aside",
        { "aria-label": "Readings and legs" },
        h(
          "section",
          {},
          h(
            "div",
            { class: "bar" },
            h("h2", {}, "Readings"),
            h("button", { type: "button", onclick: () => { status.textContent = ""; show(machine.home); } }, "Home"),
          ),
          h("p", { class: "small" }, how(content)),
          ...(same ? [h("p", { class: "small" }, sense(machine.readings[0]))] : []),
          h("ul", { class: "readings" }, ...sliders.map((slider) => slider.element(!same))),
          status,
        ),
        h("section", {}, h("h2", {}, "Platform"), platform.element),
        h("section", {}, h("h2", {}, "Legs"), legs.element),
      ),
    ),
  );
  show(machine.home);
  for (const layer of ["workspace", "cameras"] as const) model?.setLayer(layer, false);
  if (machine.cameras.length) model?.setLayer("cameras", true);
  fit(first);
}

/** What the sliders do. */
function how(content: MachineDocument): string {
  if (content.sweeps === null) {
    return content.redundant
      ? "The platform moves as little as the reading needs; the other readings follow."
      : "The others stay as they are.";
  }
  return "One reading at a time, the others as at home" +
    (content.redundant ? " or following." : ".") +
    " The poses were computed when this page was written; without -o, pkmcal show moves all" +
    " readings together.";
}

/** Sense of a reading's sign. */
const sense = (reading: Reading): string => `+ ${reading.direction} · 0: ${reading.zero}`;

/** Slider of a reading, with a field for its value. */
class Slider {
  onchange: (value: number) => void = () => undefined;
  private readonly range: HTMLInputElement;
  private readonly field: HTMLInputElement;

  constructor(
    private readonly reading: Reading,
    private readonly index: number,
    content: MachineDocument,
  ) {
    const { low, high, name, unit } = reading;
    const { factor, decimals } = UNITS[unit];
    const label = `${name}, ${UNITS[unit].name === "°" ? "degrees" : "millimetres"}`;
    const send = (value: number): void => {
      if (Number.isFinite(value)) this.onchange(Math.min(Math.max(value, low), high));
    };
    this.range = h("input", {
      type: "range", min: low, max: high, step: (high - low) / (content.sweeps ? 400 : 2000),
      "aria-label": label, oninput: () => send(this.range.valueAsNumber),
    });
    this.field = h("input", {
      type: "number", min: (low * factor).toFixed(decimals), max: (high * factor).toFixed(decimals),
      step: "any", "aria-label": `${label}, value`,
      onchange: () => send(this.field.valueAsNumber / factor),
    });
  }

  element(withSense: boolean): HTMLElement {
    const { low, high, name, unit, legs, stated } = this.reading;
    const { factor, name: unitName } = UNITS[unit];
    const end = (value: number): HTMLElement =>
      h("span", { class: "small end" }, (stated ? "" : "~") + number(value * factor, 0));
    return h(
      "li",
      { "data-reading": this.index },
      h(
        "div",
        { class: "head" },
        ...legs.map(chip),
        h("span", { class: "name" }, name),
        this.field,
        h("span", { class: "unit" }, unitName),
      ),
      h("div", { class: "track" }, end(low), this.range, end(high)),
      ...(withSense ? [h("p", { class: "small" }, sense(this.reading))] : []),
    );
  }

  show(value: number, beyond: boolean): void {
    const { factor, decimals } = UNITS[this.reading.unit];
    this.range.value = String(value);
    this.field.value = (value * factor).toFixed(decimals);
    this.mark(beyond);
  }

  /** Mark a value at which there is no pose. */
  refuse(value: number): void {
    this.show(value, true);
  }

  private mark(invalid: boolean): void {
    for (const input of [this.range, this.field]) input.setAttribute("aria-invalid", String(invalid));
  }
}

/** Position and turn of the platform, and its way from home. */
function platformTable(home: Configuration) {
  const cells = ["x", "y", "z", "rx", "ry", "rz"].map((name) => ({ name, cell: h("td") }));
  const way = h("td", { colspan: 5 });
  const row = (label: string, part: typeof cells, unit: string): HTMLElement =>
    h("tr", {}, h("th", { scope: "row" }, label), ...part.map((one) => one.cell), h("td", { class: "unit" }, unit));
  const element = h(
    "table",
    { class: "platform" },
    h("thead", {}, h("tr", {}, h("td"), ...["x", "y", "z"].map((name) => h("th", { scope: "col" }, name)), h("td"))),
    h(
      "tbody",
      {},
      row("Position", cells.slice(0, 3), "mm"),
      row("Rotation vector", cells.slice(3), "°"),
      h("tr", {}, h("th", { scope: "row" }, "From home"), way),
    ),
  );
  const position = (one: Configuration): number[] =>
    one.T_base_platform.slice(0, 3).map((r) => r[3]);
  const update = (one: Configuration): void => {
    const p = position(one);
    [...p.map((x) => number(x * 1e3, 2)), ...one.rotation.map((x) => number((x * 180) / Math.PI, 3))]
      .forEach((text, k) => (cells[k].cell.textContent = text));
    const distance = Math.hypot(...position(home).map((x, k) => p[k] - x));
    way.textContent = quantity(distance, "m");
  };
  return { element, update };
}

/** Legs as buttons, and the values of the chosen one. */
function legsList(content: MachineDocument, onchoice: (leg: number | null) => void) {
  const rows = h("div", { class: "leg-rows" });
  let current: number | null = null;
  const choose = (leg: number | null): void => {
    current = leg === current ? null : leg;
    buttons.forEach((button, j) => button.setAttribute("aria-pressed", String(j === current)));
    rows.replaceChildren(
      current === null
        ? h("p", { class: "small" }, "Choose a leg, here or in space, for its values.")
        : legTable(content.machine, current),
    );
    onchoice(current);
    if (current !== null) rows.scrollIntoView({ block: "nearest" });
  };
  const buttons = content.machine.legs.map((leg, j) =>
    h(
      "button",
      {
        type: "button", class: `chip ${legClass(j + 1)}`, "aria-pressed": "false",
        "aria-label": `Leg ${leg.number}`, onclick: () => choose(j),
      },
      String(leg.number),
    ));
  rows.append(h("p", { class: "small" }, "Choose a leg, here or in space, for its values."));
  return { element: h("div", {}, h("div", { class: "leg-buttons" }, ...buttons), rows), choose };
}

/** Tooltip and highlight of the leg under the pointer. */
function hovering(
  stage: Stage,
  content: MachineDocument,
  chosen: () => number[] | null,
  highlight: (legs: number[] | null) => void,
) {
  let last: number | null = null;
  const onpick = (picked: Picked | null): void => {
    const leg = picked?.leg ?? null;
    stage.showTooltip(leg === null ? null : legTable(content.machine, leg));
    if (leg === last) return;
    last = leg;
    highlight(leg === null ? chosen() : [leg]);
  };
  return { onpick };
}

function layerSwitches(
  content: MachineDocument,
  onchange: (layer: Layer, visible: boolean) => void,
): HTMLElement {
  const { machine } = content;
  const present: Record<Layer, boolean> = {
    signs: machine.readings.length > 0,
    axes: machine.axes.length > 0,
    frames: true,
    workspace: machine.workspace.length > 0,
    cameras: machine.cameras.length > 0,
  };
  const names = (Object.keys(LAYERS) as Layer[]).filter((layer) => present[layer]);
  return h(
    "fieldset",
    { class: "layers" },
    h("legend", { class: "hidden" }, "Shown"),
    ...names.map((layer) => {
      const box = h("input", {
        type: "checkbox", checked: layer !== "workspace",
        onchange: () => onchange(layer, box.checked),
      });
      return h("label", {}, box, LAYERS[layer]);
    }),
  );
}
