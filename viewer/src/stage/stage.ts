/**
 * The stage: a canvas in space with its camera, labels and tooltip. It draws on demand, opens on
 * what it is given to fit, and is used by pointer, touch and keyboard.
 */

import {
  DirectionalLight,
  HemisphereLight,
  type Object3D,
  PerspectiveCamera,
  Raycaster,
  Scene,
  Spherical,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { h } from "../dom";
import { type Label, Labels } from "./labels";
import { Palette } from "./palette";

const FIELD = 26; // vertical field of view, degrees
const PAPER = ["680px", "258px"]; // within the margins of A4, at 96 px an inch
const MARGIN = 0.88; // share of the picture for what is fitted
const KEY_TURN = Math.PI / 36;
const KEY_ZOOM = 1.15;
const SOON = 150; // ms
const TAP = 5; // px; a pointer that moves by less has tapped

/** Directions towards the eye. */
export const VIEWS: Record<string, Vector3> = {
  "Reset view": new Vector3(0.75, -1, 0.55),
  "From above": new Vector3(0, -0.001, 1),
  "From the side": new Vector3(0, -1, 0.02),
};
export const PLANE_VIEW = new Vector3(0.15, -0.6, 1);
export const NO_WEBGL = "This browser draws nothing in space: it has no WebGL, or it is switched off.";

/** What is under the pointer: a leg, or a part that has a key and a text. */
export interface Picked {
  leg: number | null;
  part: { key: string; tip: string } | null;
}

export class Stage {
  readonly scene = new Scene();
  readonly palette = new Palette(() => this.drawNow());
  readonly element: HTMLElement;
  /** Objects that can be hovered; `userData` holds their leg, or the parts of their instances. */
  readonly pickable: Object3D[] = [];
  onpick: (picked: Picked | null) => void = () => undefined;
  ontap: (picked: Picked | null) => void = () => undefined;

  private readonly renderer: WebGLRenderer;
  private readonly camera = new PerspectiveCamera(FIELD, 1, 0.01, 100);
  private readonly controls: OrbitControls;
  private readonly labels = new Labels();
  private readonly tooltip = h("div", { class: "tooltip", role: "status", hidden: true });
  private readonly pointer = new Vector2();
  private pending = false;
  private fitted: { points: Vector3[]; direction: Vector3 } | null = null;
  private untouched = true;

  /**
   * Throws an error where the browser has no WebGL.
   * inPage : whether the stage is a part of a page that scrolls.
   */
  constructor(description: string, inPage = false) {
    // what was drawn last stays readable, for print
    this.renderer = new WebGLRenderer({
      antialias: true, alpha: true, preserveDrawingBuffer: true, powerPreference: "low-power",
    });
    const canvas = this.renderer.domElement;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", description);
    this.element = h("div", { class: "stage" }, canvas, this.labels.layer, this.tooltip);

    this.camera.up.set(0, 0, 1);
    this.scene.add(new HemisphereLight(0xffffff, 0x98a0b0, 2.8));
    const sun = new DirectionalLight(0xffffff, 1.8);
    sun.position.set(0.4, 0.6, 1);
    this.camera.add(sun); // shades from the eye's side, whatever the view
    this.scene.add(this.camera);

    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.zoomToCursor = true;
    this.controls.addEventListener("change", () => this.draw());
    this.controls.addEventListener("start", () => (this.untouched = false));
    if (inPage) this.leaveScrolling(canvas);

    new ResizeObserver(() => this.resize()).observe(this.element);
    canvas.addEventListener("keydown", (event) => this.key(event));
    this.listen(canvas);
  }

  /** Draw before the next repaint; a page that is not repainted soon anyway. */
  draw(): void {
    if (this.pending) return;
    this.pending = true;
    const now = (): void => {
      if (this.pending) this.drawNow();
    };
    requestAnimationFrame(now);
    setTimeout(now, SOON);
  }

  /** Draw at once, as a page needs that is about to be printed. */
  private drawNow(): void {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (!width || !height) return;
    // on paper the element has another size, before any observer is called
    const size = this.renderer.getSize(new Vector2());
    if (size.x !== width || size.y !== height) this.resize();
    this.pending = false;
    this.renderer.render(this.scene, this.camera);
    this.labels.place(this.camera, width, height);
  }

  /**
   * Take the size of a picture on paper, before the page is laid out for it, and be drawn in it;
   * returns the step that undoes this.
   */
  forPaper(): () => void {
    const { style } = this.element;
    const { position, target } = { position: this.camera.position.clone(), target: this.controls.target.clone() };
    const untouched = this.untouched;
    [style.width, style.height] = PAPER;
    this.drawNow();
    return () => {
      style.width = style.height = "";
      this.resize();
      if (untouched) return;
      this.camera.position.copy(position);
      this.controls.target.copy(target);
      this.controls.update();
    };
  }

  setLabels(labels: Label[]): void {
    this.labels.replace(labels);
    this.draw();
  }

  /** Move the eye so that all points are in view, in a direction from them towards the eye. */
  fit(points: Vector3[], direction: Vector3): void {
    this.fitted = { points, direction };
    this.untouched = true;
    const { clientWidth: width, clientHeight: height } = this.element;
    if (!width || !height) return;
    const back = direction.clone().normalize();
    const right = new Vector3(0, 0, 1).cross(back).normalize();
    if (right.lengthSq() < 0.5) right.set(1, 0, 0);
    const up = back.clone().cross(right);
    // A point at depth z in front of an eye at distance D is in view if it lies within
    // slope (D - z) of the axis; on each axis the extreme points fix the centre and the distance.
    const slope = Math.tan((FIELD * Math.PI) / 360) * MARGIN;
    const centre = new Vector3();
    let distance = 0;
    for (const [axis, own] of [[right, (slope * width) / height], [up, slope]] as const) {
      let [positive, negative] = [-Infinity, -Infinity];
      for (const p of points) {
        const across = p.dot(axis) / own;
        positive = Math.max(positive, p.dot(back) + across);
        negative = Math.max(negative, p.dot(back) - across);
      }
      centre.addScaledVector(axis, (own * (positive - negative)) / 2);
      distance = Math.max(distance, (positive + negative) / 2);
    }
    const depths = points.map((p) => p.dot(back));
    const middle = (Math.min(...depths) + Math.max(...depths)) / 2;
    this.controls.target.copy(centre).addScaledVector(back, middle);
    this.camera.position.copy(centre).addScaledVector(back, distance);
    const reach = distance - Math.min(...depths);
    this.camera.near = reach / 200;
    this.camera.far = reach * 20;
    this.controls.minDistance = reach / 100;
    this.controls.maxDistance = reach * 6;
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.draw();
  }

  /** Show the tooltip beside the pointer, or hide it. */
  showTooltip(content: Node | null): void {
    this.tooltip.hidden = !content;
    if (!content) return;
    this.tooltip.replaceChildren(content);
    const { clientWidth: width, clientHeight: height } = this.element;
    const { offsetWidth: w, offsetHeight: t } = this.tooltip;
    const [x, y] = [((this.pointer.x + 1) / 2) * width, ((1 - this.pointer.y) / 2) * height];
    const left = x + 16 + w < width ? x + 16 : Math.max(4, x - 16 - w);
    this.tooltip.style.left = `${left}px`;
    this.tooltip.style.top = `${Math.max(4, Math.min(y + 12, height - t - 4))}px`;
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (this.fitted && this.untouched) this.fit(this.fitted.points, this.fitted.direction);
    this.draw();
  }

  private key(event: KeyboardEvent): void {
    const turns: Record<string, [number, number]> = {
      ArrowLeft: [-KEY_TURN, 0],
      ArrowRight: [KEY_TURN, 0],
      ArrowUp: [0, -KEY_TURN],
      ArrowDown: [0, KEY_TURN],
    };
    const zooms: Record<string, number> = { "+": 1 / KEY_ZOOM, "=": 1 / KEY_ZOOM, "-": KEY_ZOOM };
    const { target } = this.controls;
    // spherical coordinates have y upwards, the stage z
    const offset = this.camera.position.clone().sub(target);
    const around = new Spherical().setFromCartesianCoords(offset.y, offset.z, offset.x);
    if (turns[event.key]) {
      around.theta += turns[event.key][0];
      around.phi = Math.min(Math.max(around.phi + turns[event.key][1], 0.01), Math.PI - 0.01);
    } else if (zooms[event.key]) around.radius *= zooms[event.key];
    else if (event.key === "Home" && this.fitted) {
      this.fit(this.fitted.points, this.fitted.direction);
      event.preventDefault();
      return;
    } else return;
    event.preventDefault();
    this.untouched = false;
    const { x, y, z } = new Vector3().setFromSpherical(around);
    this.camera.position.set(z, x, y).add(target);
    this.controls.update();
    this.draw();
  }

  /** A finger's vertical motion, and the wheel before a click on the stage, scroll the page. */
  private leaveScrolling(canvas: HTMLCanvasElement): void {
    canvas.style.touchAction = "pan-y";
    let clicked = false;
    canvas.addEventListener("pointerdown", () => (this.controls.enableZoom = clicked = true), true);
    canvas.addEventListener("pointerleave", () => (clicked = false));
    const allow = (event: WheelEvent): void => {
      this.controls.enableZoom = clicked || event.ctrlKey;
    };
    this.element.addEventListener("wheel", allow, { capture: true, passive: true });
  }

  private listen(canvas: HTMLCanvasElement): void {
    let down: { x: number; y: number } | null = null;
    const aim = (event: PointerEvent): void => {
      const box = canvas.getBoundingClientRect();
      this.pointer.set(
        ((event.clientX - box.left) / box.width) * 2 - 1,
        1 - ((event.clientY - box.top) / box.height) * 2,
      );
    };
    canvas.addEventListener("pointerdown", (event) => {
      down = { x: event.clientX, y: event.clientY };
      this.onpick(null);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (event.pointerType === "touch" || event.buttons) return;
      aim(event);
      this.onpick(this.picked());
    });
    canvas.addEventListener("pointerup", (event) => {
      const moved = down ? Math.hypot(event.clientX - down.x, event.clientY - down.y) : Infinity;
      down = null;
      if (moved > TAP) return;
      aim(event);
      this.ontap(this.picked());
    });
    canvas.addEventListener("pointerleave", () => this.onpick(null));
  }

  private picked(): Picked | null {
    const caster = new Raycaster();
    caster.setFromCamera(this.pointer, this.camera);
    const visible = this.pickable.filter((object) => object.visible && object.parent?.visible);
    const hit = caster.intersectObjects(visible, false)[0];
    if (!hit) return null;
    const { leg, parts } = hit.object.userData as { leg?: number; parts?: NonNullable<Picked["part"]>[] };
    return { leg: leg ?? null, part: parts?.[hit.instanceId ?? 0] ?? null };
  }
}
