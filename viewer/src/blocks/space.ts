/** Block of a machine in space: the stage with a slider through its poses and its enlargement. */

import { Vector3 } from "three";
import type { Space } from "../document";
import { h, number } from "../dom";
import type { Key } from "../selection";
import { legTable } from "../stage/legs";
import { FrustumImages } from "../stage/frusta";
import { type SpaceState, SpaceModel } from "../stage/space";
import { NO_WEBGL, PLANE_VIEW, Stage, VIEWS } from "../stage/stage";
import type { Context } from "./index";
import "./space.css";

const MOST_ENLARGED = { changes: 100, ellipsoids: 1000 };
const MORPH = 500; // ms from one machine to the other
const FRAME = 16; // ms between two pictures of a motion
const TOUR = 12_000; // ms through all poses, at most SLOWEST each
const SLOWEST = 600;
const BESIDE = 1.2; // largest angle between the eye and a camera, rad
const HEIGHT = 0.4; // of the eye above the horizon, as a slope

type Links = Pick<Context, "selection"> & Partial<Pick<Context, "viewer" | "printSteps">>;

export function space(block: Space, context: Links): HTMLElement {
  const figure = h("figure", { class: "space-block" });
  if (block.title) figure.append(h("h3", {}, block.title));
  let stage: Stage;
  try {
    stage = new Stage(
      `${block.alt} Drag or use the arrow keys to turn; + and − zoom, as the wheel does after a click;` +
        " Home resets.",
      true,
    );
  } catch {
    figure.append(h("p", { class: "box" }, `${NO_WEBGL} The tables of this page are complete.`), h("figcaption", { class: "small" }, block.caption));
    return figure;
  }
  const model = new SpaceModel(block, stage);
  const state: SpaceState = {
    pose: 0, share: 1, enlargement: block.enlargement, ellipsoids: block.ellipsoid_enlargement,
  };
  const frusta = new FrustumImages(block.machine.cameras, model.model.layers.cameras, stage);
  const draw = (): void => model.show(state);
  /** Images of the pose's configuration, as far as the page has them. */
  const project = (): void => {
    const key = block.poses[state.pose]?.key ?? "";
    frusta.show((camera) => context.viewer?.find(`image:${camera}/${key.slice(key.indexOf(":") + 1)}`));
  };

  const poses = poseBar(block, (pose) => {
    state.pose = pose;
    draw();
    project();
  });
  const change = changeBar(block, state, draw, stage.element);
  select(block, context, stage, model, poses.choose);

  const first = block.machine.motion.startsWith("planar") ? PLANE_VIEW : betweenCameras(block);
  const fit = (direction: Vector3, all = false): void =>
    stage.fit(all ? model.allPoints() : model.machinePoints(), direction);
  const views = Object.entries({ ...VIEWS, "Reset view": first }).map(([name, direction]) =>
    h("button", { type: "button", onclick: () => fit(direction) }, name));
  if (block.machine.cameras.length) {
    views.push(h("button", { type: "button", onclick: () => fit(first, true) }, "With cameras"));
  }
  figure.append(
    h("div", { class: "space-stage" }, stage.element),
    ...(block.poses.length > 1 ? [poses.element] : []),
    ...(change ? [change] : []),
    h("div", { class: "bar" }, ...views, switches(block, model)),
    h("figcaption", { class: "small" },
      `${block.caption} Lines of the ground every ${number(model.model.gridStep * 1e3, 0)} mm.`),
  );
  draw();
  fit(first);
  context.printSteps?.push(() => stage.forPaper());
  setTimeout(project); // the blocks with images are drawn by then
  return figure;
}

/** Direction towards the eye from the widest gap between the cameras, none in front of the machine. */
function betweenCameras({ machine }: Space): Vector3 {
  const middle = new Vector3();
  const joints = machine.home.legs.flatMap((leg) => [...leg.base, ...leg.platform]);
  for (const p of joints) middle.add(new Vector3(...p));
  middle.divideScalar(Math.max(joints.length, 1));
  const around = machine.cameras
    .map(({ position: [x, y] }) => Math.atan2(y - middle.y, x - middle.x))
    .sort((a, b) => a - b);
  if (!around.length) return VIEWS["Reset view"];
  const gaps = around.map((angle, k) => (around[k + 1] ?? around[0] + 2 * Math.PI) - angle);
  const widest = Math.max(...gaps);
  const angle = around[gaps.indexOf(widest)] + Math.min(widest / 2, BESIDE);
  return new Vector3(Math.cos(angle), Math.sin(angle), HEIGHT);
}

/** Slider through the poses, with a button that plays them. */
function poseBar(block: Space, onchange: (pose: number) => void) {
  const name = h("output", {});
  const slider = h("input", {
    type: "range", min: 0, max: block.poses.length - 1, step: 1, value: 0, "aria-label": "Configuration",
    oninput: () => choose(slider.valueAsNumber),
  });
  const choose = (pose: number): void => {
    stop();
    go(pose);
  };
  const go = (pose: number): void => {
    slider.value = String(pose);
    const { label } = block.poses[pose];
    name.textContent = label;
    slider.setAttribute("aria-valuetext", label);
    onchange(pose);
  };
  let timer = 0;
  const stop = (): void => {
    clearInterval(timer);
    timer = 0;
    play.textContent = "▶ Play";
  };
  const play = h("button", {
    type: "button",
    onclick: () => {
      if (timer) return stop();
      play.textContent = "❚❚ Pause";
      timer = window.setInterval(
        () => go((slider.valueAsNumber + 1) % block.poses.length),
        Math.min(TOUR / block.poses.length, SLOWEST),
      );
    },
  }, "▶ Play");
  if (block.poses.length) name.textContent = block.poses[0].label;
  return { element: h("div", { class: "bar poses" }, play, slider, name), choose };
}

/** Sliders from one machine to the other, and of enlargements; none where nothing is enlarged. */
function changeBar(
  block: Space,
  state: SpaceState,
  draw: () => void,
  stage: HTMLElement,
): HTMLElement | null {
  if (!block.changes.length && !block.arrows.length && !block.ellipsoids.length) return null;
  const [before, after] = block.names;
  const morph = h("input", {
    type: "range", min: 0, max: 1, step: 0.01, value: 1, "aria-label": `From ${before} to ${after}`,
    oninput: () => {
      runs += 1;
      state.share = morph.valueAsNumber;
      draw();
    },
  });
  let runs = 0;
  const turnOver = (): void => {
    const [from, to] = [state.share, state.share < 0.5 ? 1 : 0];
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const began = performance.now();
    const own = (runs += 1);
    const step = (): void => {
      if (own !== runs) return; // another motion has begun
      const t = still ? 1 : Math.min((performance.now() - began) / MORPH, 1);
      state.share = from + (to - from) * t * t * (3 - 2 * t);
      morph.value = String(state.share);
      draw();
      if (t < 1) setTimeout(step, FRAME);
    };
    step();
  };
  const parts: HTMLElement[] = [];
  if (block.changes.length) {
    stage.addEventListener("keydown", (event) => {
      if (event.key !== " ") return;
      event.preventDefault();
      turnOver();
    });
    parts.push(h("div", { class: "range" }, h("span", {}, before), morph, h("span", {}, after),
      h("button", { type: "button", title: "Space bar on the stage", onclick: turnOver }, "⇄")));
  }
  if (block.changes.length || block.arrows.length) {
    parts.push(enlarger(block.changes.length ? "Change" : "Arrows", state.enlargement, MOST_ENLARGED.changes, (factor) => {
      state.enlargement = factor;
      draw();
    }));
  }
  if (block.ellipsoids.length) {
    parts.push(enlarger("Ellipsoids", state.ellipsoids, MOST_ENLARGED.ellipsoids, (factor) => {
      state.ellipsoids = factor;
      draw();
    }));
  }
  return h("div", { class: "bar changes" }, ...parts);
}

/** Slider of an enlargement, from true to scale, in equal ratios. */
function enlarger(name: string, start: number, most: number, onchange: (factor: number) => void): HTMLElement {
  const text = h("output", {});
  const slider = h("input", {
    type: "range", min: 0, max: Math.log10(most), step: 0.01, value: Math.log10(start),
    "aria-label": `Enlargement: ${name}`,
    oninput: () => {
      const factor = 10 ** slider.valueAsNumber;
      label(factor);
      onchange(factor);
    },
  });
  const label = (factor: number): void => {
    text.textContent = `× ${number(factor, factor < 9.95 ? 1 : 0)}`;
    slider.setAttribute("aria-valuetext", text.textContent);
  };
  label(start);
  return h("div", { class: "range" }, h("span", {}, name), slider, text);
}

/** Selection shared with the page: legs, and configurations by their points and the slider. */
function select(
  block: Space, { selection }: Links, stage: Stage, model: SpaceModel, go: (pose: number) => void,
): void {
  const { legs } = block.machine;
  const legKey = (leg: number): Key => `leg:${legs[leg].number}`;
  stage.onpick = (picked) => {
    const { leg = null, part = null } = picked ?? {};
    stage.showTooltip(leg !== null ? legTable(block.machine, leg) : part?.tip ? h("p", {}, part.tip) : null);
    selection.hover(leg !== null ? legKey(leg) : part?.key || null);
  };
  stage.ontap = (picked) => {
    if (!picked) return;
    const key = picked.leg !== null ? legKey(picked.leg) : picked.part?.key;
    if (key) selection.choose(key);
  };
  /** Pose of a configuration's key, or of an image's. */
  const poseOf = (key: Key | null): number => {
    const name = key?.startsWith("image:") ? `configuration:${key.slice(key.indexOf("/") + 1)}` : key;
    return name ? block.poses.findIndex((pose) => pose.key === name) : -1;
  };
  let [before, highlighted]: [Key | null, number] = [null, -1];
  selection.subscribe((hovered, chosen) => {
    const legOf = (key: Key | null): number => legs.findIndex((_leg, j) => legKey(j) === key);
    const leg = legOf(hovered) >= 0 ? legOf(hovered) : legOf(chosen);
    if (leg !== highlighted) model.model.highlight(leg < 0 ? null : [leg]);
    highlighted = leg;
    const near = poseOf(hovered);
    model.mark(near >= 0 ? block.poses[near].key : null);
    const pose = poseOf(chosen);
    if (chosen !== before && pose >= 0) go(pose);
    before = chosen;
  });
}

/** Checkboxes of what is drawn, with its colour. */
function switches(block: Space, model: SpaceModel): HTMLElement {
  const layer = (name: "cameras" | "axes" | "frames", text: string, visible: boolean): Node => {
    model.model.setLayer(name, visible);
    return box(text, "", visible, (on) => model.model.setLayer(name, on));
  };
  return h("fieldset", { class: "layers" },
    h("legend", { class: "hidden" }, "Shown"),
    ...model.items.map((item) => box(item.name, item.colour, item.visible, item.show)),
    ...(block.machine.cameras.length ? [layer("cameras", "Cameras", true)] : []),
    ...(block.machine.axes.length ? [layer("axes", "Joint axes", false)] : []),
    layer("frames", "Frames", true));
}

function box(name: string, colour: string, visible: boolean, onchange: (visible: boolean) => void): Node {
  const input = h("input", { type: "checkbox", checked: visible, onchange: () => onchange(input.checked) });
  const key = h("span", { class: "colour-key" });
  if (colour) key.style.setProperty("--c", `var(${colour})`);
  return h("label", {}, input, ...(colour ? [key] : []), name);
}
