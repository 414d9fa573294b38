/**
 * Page of a session: its images with the machine laid over, which can be moved to its place. The
 * page knows no camera model: every pixel of the machine comes from the program, also in a drag.
 */

import "./session.css";
import { space } from "../blocks/space";
import type {
  EdgesAnswer,
  Gesture,
  JointPixel,
  Layer,
  LocalizationAnswer,
  OverlayAnswer,
  Pin,
  SavedAnswer,
  SessionDocument,
  Space,
  ViewRequest,
} from "../document";
import { h } from "../dom";
import { type DragTool, Inspector, type Pixel } from "../inspector";
import { legClass, sign } from "../marks";
import { Selection, connect } from "../selection";
import { button, choice, press } from "./buttons";
import { ImageList, type ImageMark } from "./session_images";
import { type Pose, StationPose } from "./session_poses";

type MachineChoice = ViewRequest["machine"];
type Kind = Gesture["kind"] | "number" | "pan";

const DISTANCE_STEP = 1.05; // ratio of distances, of one press
const DRAG_STEP = 12; // screen pixels of a drag for the same
const REACH = { mouse: 9, touch: 24 }; // screen pixels from a joint to the pointer that takes it
const JITTER = 3; // screen pixels within which a drag has not begun
const PINS_TO_FIT = 2; // joints placed by hand, after which the machine is localized
const PAUSE = 250; // ms without a change of the distance, after which the next is another step
const ORDER: Layer["name"][] = ["rejected", "machine", "edges", "corners", "joints"];
const KINDS: [Kind, string, string][] = [
  ["aim", "Move", "Drag the machine, or one joint after the other, to its place"],
  ["turn", "Turn", "Turn the machine about its middle; Shift and drag"],
  ["roll", "Roll", "Turn it about the line of sight; Alt and drag"],
  ["distance", "Distance", "Drag up: farther; Page Up and Page Down"],
  ["number", "Number legs", "Click on a leg: it is the one of this number; click again: it is not"],
  ["pan", "Pan", "Drag the image; two fingers do so always"],
];
const HELP = "Drag the machine to where the image has it. A joint that is dragged stays where it is put: the"
  + " first moves the machine, the second turns and scales it, and then the machine is localized as by Fit."
  + " A machine of equal legs looks alike from several sides: number a leg that you know, and Fit takes it for that one."
  + " Shift turns, Alt rolls, Page Up and Page Down change the distance; the wheel zooms the image."
  + " ← → previous and next image, ↑ ↓ stations.";

interface Drag {
  kind: Exclude<Kind, "pan">;
  reach: number;
  joint: JointPixel | null;
  start: Pixel;
  screen: { x: number; y: number };
  pose: Pose | null;
  others: Pin[];
  moved: boolean;
}

export function sessionView(host: HTMLElement, content: SessionDocument): void {
  new SessionView(host, content).open();
}

class SessionView {
  private s = 0;
  private k = 0;
  private machine: MachineChoice = "nominal";
  private kind: Kind = "aim";
  private leg = 1; // whose number a click places
  private readonly poses: StationPose[];
  private readonly marks: Record<MachineChoice, ImageMark[][]>;
  /** Answers about another image, machine or pose than the present one are dropped. */
  private epoch = 0;
  private drag: Drag | null = null;
  private waiting: { body: ViewRequest; epoch: number } | null = null;
  private overlaying: Promise<void> | null = null;
  private measuring = 0;
  private marking = false;
  private distance: { pose: Pose | null; factor: number; timer: number; epoch: number } | null = null;
  private overlay: Layer[] = [];
  private measured: Layer[] = [];
  private joints: JointPixel[] = [];
  private stageState: "absent" | "requested" | "drawn" = "absent";

  private readonly selection = new Selection();
  private readonly list: ImageList;
  private readonly inspector: Inspector;
  private readonly where = h("h2", {});
  private readonly status = h("div", { class: "session-status", role: "status", "aria-live": "polite", hidden: true });
  private readonly places = h("div", { class: "bar session-places", hidden: true });
  private readonly fit = h("div", { class: "session-fit" });
  private readonly counts: HTMLElement[];
  private readonly reasons = h("ul", { class: "small" });
  private readonly place = h("dl", { class: "session-place" });
  private readonly origin = h("p", { class: "small" });
  private readonly stage = h("div", { class: "session-stage", hidden: true });
  private readonly machines: HTMLElement;
  private readonly views: HTMLElement;
  private readonly kinds: HTMLElement;
  private readonly numbers: HTMLElement;
  private readonly undoButton = button("Undo", () => this.undo(), "Ctrl Z");
  private readonly fitButton = button("Fit", () => void this.localize(false), "Key f");
  private readonly searchButton = button("Search everywhere", () => void this.localize(true));
  private readonly saveButton = button("Write into session.yaml", () => void this.save());
  private readonly editing: HTMLElement[];

  constructor(host: HTMLElement, private readonly content: SessionDocument) {
    const { stations, legs } = content;
    this.poses = stations.map((station) => new StationPose(station.posed));
    const none = (): ImageMark[][] => stations.map((station) => station.images.map(() => undefined));
    this.marks = { nominal: none(), calibration: none() };
    this.list = new ImageList(content, (s, k) => this.go(s, k));
    this.list.show(this.marks.nominal);
    this.inspector = new Inspector((by) => this.walk(by), () => undefined, this.dragTool());
    this.counts = Array.from({ length: legs }, () => h("span", { class: "small" }));
    this.machines = choice("Machine laid over", [["nominal", "Nominal"], ["calibration", "Calibrated"]],
      "nominal", (name) => this.choose(name));
    this.views = choice("View", [["image", "Image"], ["space", "In space"]], "image", (name) => this.showSpace(name === "space"));
    this.views.hidden = !content.calibration;
    this.kinds = choice("What a drag does", KINDS, "aim", (name) => {
      this.kind = name;
      this.showState();
    });
    this.numbers = choice("Number of the leg", Array.from({ length: legs }, (_, j): [string, string] => [String(j + 1), String(j + 1)]),
      "1", (name) => {
        this.leg = Number(name);
      });
    for (const one of [this.fitButton, this.saveButton]) one.classList.add("main");
    const middle = (): Pixel => [(this.image.width - 1) / 2, (this.image.height - 1) / 2];
    const tools = h("div", { class: "bar session-tools" }, this.kinds, this.numbers,
      h("span", { class: "choice", role: "group", "aria-label": "Distance" },
        button("Nearer", () => this.changeDistance(1 / DISTANCE_STEP, middle()), "Page Down"),
        button("Farther", () => this.changeDistance(DISTANCE_STEP, middle()), "Page Up")),
      this.undoButton, this.fitButton, this.searchButton);
    this.editing = [tools, h("details", { class: "session-help small" }, h("summary", {}, "How to move the machine"), HELP)];

    host.classList.add("session");
    host.append(
      h("header", { class: "top" },
        h("p", { class: "kicker" }, `${content.program} · session`),
        h("h1", {}, content.title),
        ...(content.report ? [h("p", {}, h("a", { href: content.report }, "Report of its calibration"))] : [])),
      h("main", {},
        this.list.element,
        h("section", { class: "session-image", "aria-label": "Image" },
          h("div", { class: "bar" }, this.where, this.views, this.machines),
          this.inspector.element, this.stage, ...this.editing),
        h("aside", { "aria-label": "Measurements and pose" },
          this.status, this.places,
          h("section", {}, h("h2", {}, "Measurements"), this.fit,
            h("ul", { class: "session-legs", "aria-label": "Legs, and how many of their edges are measured" },
              ...this.counts.map((cell, j) => h("li", { "data-key": `leg:${j + 1}` },
                h("span", { class: `chip on-image ${legClass(j + 1)}` }, String(j + 1)), " ", cell))),
            legend(), this.reasons),
          h("section", {}, h("h2", {}, "Pose of the station"), this.place, this.origin, h("p", {}, this.saveButton)))),
    );
    connect(host, this.selection);
    this.listen();
  }

  /** Show the image and machine of the address, or the first image and what its calibration found. */
  open(): void {
    const { stations, calibration } = this.content;
    const [s, k, machine] = location.hash.slice(1).split("/");
    if (calibration && machine !== "nominal") this.setMachine("calibration");
    const first = stations.findIndex((station) => station.images.length);
    if (first < 0) this.notify("The session has no images.", "bad");
    else if (stations[Number(s) - 1]?.images[Number(k) - 1]) this.go(Number(s) - 1, Number(k) - 1);
    else this.go(first, 0);
  }

  private get station(): SessionDocument["stations"][number] {
    return this.content.stations[this.s];
  }

  private get image(): SessionDocument["stations"][number]["images"][number] {
    return this.station.images[this.k];
  }

  private get pose(): StationPose {
    return this.poses[this.s];
  }

  private get fixed(): boolean {
    return this.machine === "calibration";
  }

  // ---------------------------------------------------------------- requests

  private request(more: Partial<ViewRequest> = {}, s = this.s, k = this.k): ViewRequest {
    const { pose, numbers } = this.poses[s];
    return {
      station: s, image: k, machine: this.machine, pose: this.fixed ? null : pose, gesture: null,
      anywhere: false, ...more, pins: [...(more.pins ?? []), ...numbers],
    };
  }

  /** Answer, or the message of a fault. */
  private async post<T>(path: string, body: ViewRequest): Promise<T | { message: string }> {
    try {
      const response = await fetch(path, { method: "POST", body: JSON.stringify(body) });
      return (await response.json()) as T | { message: string };
    } catch {
      return { message: "pkmcal no longer answers: was it interrupted?" };
    }
  }

  /** Answer, or null after a fault, which the page shows unless another image or pose is present by then. */
  private async query<T extends object>(path: string, body: ViewRequest): Promise<T | null> {
    const { epoch } = this;
    const answer = await this.post<T>(path, body);
    if (!("message" in answer)) return answer;
    if (epoch === this.epoch) this.notify(answer.message, "bad");
    return null;
  }

  /** Request the overlay; of changes that come faster than answers, the latest is sent. */
  private requestOverlay(more: Partial<ViewRequest> = {}): Promise<void> {
    this.waiting = { body: this.request(more), epoch: this.epoch };
    this.overlaying ??= (async () => {
      while (this.waiting) {
        const { body, epoch } = this.waiting;
        this.waiting = null;
        const answer = await this.query<OverlayAnswer>("overlay", body);
        if (answer && epoch === this.epoch) this.draw(answer);
      }
      this.overlaying = null;
    })();
    return this.overlaying;
  }

  /** Measure the edges of the image, then mark the others. */
  private async measure(): Promise<void> {
    const { epoch, s, k } = this;
    this.measuring += 1;
    const answer = await this.query<EdgesAnswer>("edges", this.request());
    this.measuring -= 1;
    if (answer && epoch === this.epoch) {
      this.showMeasured(answer);
      this.list.set(s, k, answer.mark);
    } else if (epoch === this.epoch) {
      this.list.set(s, k, "wrong");
      this.showFit("wrong", ["Not measured."]);
    }
    void this.markOthers();
  }

  /** Mark the images that have no mark, one at a time while nothing else is requested. */
  private async markOthers(): Promise<void> {
    if (this.marking) return;
    this.marking = true;
    for (;;) {
      const { machine, poses } = this;
      const marks = this.marks[machine];
      const order = [this.s, ...marks.keys()]; // this station's first
      const s = order.find((one) => marks[one].includes(undefined));
      if (s === undefined || this.drag || this.overlaying || this.measuring) break;
      const k = marks[s].indexOf(undefined);
      const { pose } = poses[s];
      const answer = await this.post<EdgesAnswer>("edges", this.request({}, s, k));
      if (machine === this.machine && pose === poses[s].pose) {
        this.list.set(s, k, "message" in answer ? "wrong" : answer.mark);
      }
    }
    this.marking = false;
  }

  // ---------------------------------------------------------------- drawing

  private draw(answer: OverlayAnswer): void {
    if (!this.fixed) this.pose.pose = answer.pose as Pose;
    this.joints = answer.joints;
    this.overlay = answer.layers;
    this.drawLayers();
    this.place.replaceChildren(...answer.place.flatMap(({ label, value }) => [h("dt", {}, label), h("dd", {}, value)]));
    this.showState();
  }

  /** Rings of the joints, in the joints' order; those that were placed by hand are filled. */
  private withPins(layer: Layer): Layer {
    const pins = this.fixed ? [] : this.pose.pins.filter((pin) => pin.image === this.k);
    const placed = ({ end, leg }: JointPixel): boolean => pins.some((pin) => pin.end === end && pin.leg === leg);
    const shapes = layer.shapes.map((shape, n) =>
      (shape.shape === "ring" ? { ...shape, filled: placed(this.joints[n]) } : shape));
    return { ...layer, shapes };
  }

  /** Numbers of legs in the image. */
  private numbered(): Layer {
    const pins = this.fixed ? [] : this.pose.numbers.filter((pin) => pin.image === this.k);
    const shapes = pins.map(({ leg, pixel }) => ({
      shape: "ring" as const, at: pixel, key: `leg:${leg}`, label: String(leg), filled: true, tip: `You: leg ${leg} is here`,
    }));
    return { name: "joints", shapes, enlargement: 1 };
  }

  private drawLayers(): void {
    const machine = this.overlay.map((layer) => (layer.name === "joints" ? this.withPins(layer) : layer));
    const layers = [...machine, ...this.measured, this.numbered()]
      .sort((a, b) => ORDER.indexOf(a.name) - ORDER.indexOf(b.name));
    this.inspector.setOverlays([{ title: "", layers }]);
    this.selection.apply(this.inspector.element);
  }

  /** Buttons and the origin of the pose. */
  private showState(): void {
    const { content, fixed, station, pose } = this;
    for (const element of this.editing) element.hidden = fixed || !this.stage.hidden;
    this.machines.hidden = !content.calibration || !this.stage.hidden; // in space, the calibrated one stands
    this.inspector.element.classList.toggle("session-editing", !fixed && this.kind !== "pan");
    this.numbers.hidden = this.kind !== "number";
    this.undoButton.disabled = fixed || !pose.undoable;
    this.fitButton.disabled = this.searchButton.disabled = fixed || !station.legs;
    this.saveButton.disabled = fixed || !pose.changed;
    this.saveButton.hidden = fixed;
    this.origin.textContent = fixed ? "As the calibration has it."
      : pose.changed ? "Moved; not in session.yaml."
        : pose.posed ? "As session.yaml has it."
          : "session.yaml has none; this is a guess to begin with.";
  }

  private showMeasured(answer: EdgesAnswer): void {
    this.measured = answer.layers;
    this.drawLayers();
    this.showFit(answer.mark, answer.texts);
    answer.legs.forEach(({ measured, predicted }, j) => {
      this.counts[j].textContent = predicted ? `${measured} of ${predicted}` : "–";
    });
    this.reasons.replaceChildren(...answer.reasons.map((text) => h("li", {}, text)));
  }

  private showFit(mark: ImageMark, texts: readonly string[]): void {
    this.fit.className = `session-fit ${mark ?? ""}`;
    this.fit.replaceChildren(...texts.map((text, n) =>
      h("p", {}, ...(n === 0 && mark ? [sign(mark), " "] : []), text)));
  }

  /** Remove what was measured for another pose. */
  private clearMeasured(): void {
    this.measured = [];
    this.drawLayers();
    this.showFit(null, ["Not measured at this pose yet."]);
    for (const cell of this.counts) cell.textContent = "–";
    this.reasons.replaceChildren();
  }

  private notify(text: string, kind = ""): void {
    this.status.textContent = text;
    this.status.className = `session-status ${kind}`;
    this.status.hidden = !text;
  }

  // ---------------------------------------------------------------- images

  private go(s: number, k: number): void {
    const image = this.content.stations[s]?.images[k];
    if (!image) return;
    Object.assign(this, { s, k });
    this.notify("");
    this.places.hidden = true;
    this.where.textContent = image.title;
    this.overlay = [];
    this.joints = [];
    this.inspector.show(image);
    this.list.select(s, k);
    this.selection.choose(null);
    this.selection.choose(image.key);
    this.restart();
  }

  /** Request overlay and measurements of another image or machine. */
  private restart(): void {
    this.epoch += 1;
    this.clearMeasured();
    this.showState();
    history.replaceState(null, "", `#${this.s + 1}/${this.k + 1}/${this.machine}`);
    void this.update();
  }

  private async update(): Promise<void> {
    await this.requestOverlay();
    await this.measure();
  }

  private walk(step: number): void {
    const numbers = this.content.stations.map((station) => station.images.length);
    let { s, k } = this;
    k += step;
    if (k < 0) k = (numbers[s -= 1] ?? 0) - 1;
    if (k >= numbers[s]) [s, k] = [s + 1, 0];
    this.go(s, k);
  }

  private choose(machine: MachineChoice): void {
    this.setMachine(machine);
    this.notify("");
    this.overlay = [];
    this.restart();
  }

  private setMachine(machine: MachineChoice): void {
    this.machine = machine;
    press(this.machines, machine);
    this.list.show(this.marks[machine]);
  }

  private showSpace(visible: boolean): void {
    this.stage.hidden = !visible;
    this.inspector.element.hidden = visible;
    this.showState();
    if (!visible) this.inspector.fit();
    else if (this.stageState === "absent") void this.drawStage();
  }

  private async drawStage(): Promise<void> {
    this.stageState = "requested";
    const block = await fetch("stage").then((response) => response.json() as Promise<Space | { message: string }>)
      .catch(() => ({ message: "pkmcal no longer answers: was it interrupted?" }));
    if ("message" in block) {
      this.stageState = "absent";
      this.notify(block.message, "bad");
      return;
    }
    this.stageState = "drawn";
    this.stage.append(space(block, { selection: this.selection }));
    this.selection.choose(null);
    this.selection.choose(this.image.key);
  }

  // ---------------------------------------------------------------- moving

  /** Begin a change of the station's pose: nothing that was measured before holds. */
  private begin(): void {
    this.pose.begin();
    this.changed();
  }

  private changed(): void {
    this.epoch += 1;
    this.marks.nominal[this.s].fill(undefined);
    this.list.show(this.marks.nominal);
    this.notify("");
    this.places.hidden = true;
    this.clearMeasured();
  }

  private undo(): void {
    if (this.fixed || this.drag || !this.pose.undo()) return;
    this.changed();
    void this.update();
  }

  private dragTool(): DragTool {
    return {
      start: (at, scale, event) => {
        const kind = event.shiftKey ? "turn" : event.altKey ? "roll" : this.kind;
        if (this.fixed || kind === "pan") return false;
        const reach = REACH[event.pointerType === "touch" ? "touch" : "mouse"] / scale;
        const joint = kind === "aim" ? this.jointNear(at, reach) : null;
        const others = this.pose.pins.filter((pin) =>
          !(joint && pin.image === this.k && pin.end === joint.end && pin.leg === joint.leg));
        this.drag = {
          kind, reach, joint, others, start: at, screen: { x: event.clientX, y: event.clientY },
          pose: this.pose.pose, moved: false,
        };
        return true;
      },
      move: (at, event) => this.moveTo(at, event),
      end: (cancelled) => void this.endDrag(cancelled),
    };
  }

  private jointNear([x, y]: Pixel, reach: number): JointPixel | null {
    const away = (joint: JointPixel): number => Math.hypot(joint.at[0] - x, joint.at[1] - y);
    const nearest = this.joints.reduce<JointPixel | null>(
      (best, joint) => (best && away(best) <= away(joint) ? best : joint), null);
    return nearest && away(nearest) <= reach ? nearest : null;
  }

  private moveTo(at: Pixel, event: PointerEvent): void {
    const { drag } = this;
    if (!drag) return;
    const { joint, kind, start, pose, screen } = drag;
    if (kind === "number") return; // a click
    if (!drag.moved) {
      if (Math.hypot(event.clientX - screen.x, event.clientY - screen.y) < JITTER) return;
      drag.moved = true;
      this.begin();
    }
    if (joint) {
      if (!this.pose.pins.length) this.pose.unpinned = pose;
      this.pose.pins = [...drag.others, { image: this.k, end: joint.end, leg: joint.leg, pixel: at }];
      void this.requestOverlay({ pose, pins: this.pose.pins });
      return;
    }
    this.pose.pins = [];
    const factor = kind === "distance" ? DISTANCE_STEP ** ((screen.y - event.clientY) / DRAG_STEP) : 1;
    const gesture = { kind, start, end: kind === "distance" ? start : at, factor };
    void this.requestOverlay({ pose, gesture });
  }

  private async endDrag(cancelled: boolean): Promise<void> {
    const { drag } = this;
    this.drag = null;
    if (drag?.kind === "number" && !cancelled) this.numberLeg(drag);
    if (!drag?.moved) return this.markOthers(); // which the drag interrupted
    if (cancelled) return this.undo();
    const { epoch } = this;
    await this.overlaying;
    if (epoch !== this.epoch) return; // another image, or another drag
    // two joints determine the place well enough for the machine to be localized there
    if (drag.joint && this.pose.pins.length >= PINS_TO_FIT && this.station.legs) await this.localize(false);
    else await this.measure();
  }

  /** Place the chosen leg's number at a pixel, or remove it from there. */
  private numberLeg({ start, reach }: Drag): void {
    const near = ({ image, pixel: [x, y] }: Pin): boolean => image === this.k && Math.hypot(x - start[0], y - start[1]) <= reach;
    this.pose.number({ image: this.k, end: "axis", leg: this.leg, pixel: start }, near);
    this.drawLayers();
    this.showState();
  }

  /** Offer poses to look at, one after the other. */
  private offer(poses: LocalizationAnswer["places"]): void {
    this.places.hidden = !poses.length;
    const names = poses.map((_, n): [string, string] => [String(n), String(n + 1)]);
    const group = choice("Where the machine may be", names, "", (name) => {
      this.begin();
      this.pose.pins = [];
      this.places.hidden = false;
      void this.requestOverlay({ pose: poses[Number(name)] }).then(() => this.measure());
    });
    this.places.replaceChildren("It may be here: ", group);
  }

  /** Change the distance; presses in quick succession are one step. */
  private changeDistance(factor: number, at: Pixel): void {
    if (this.fixed || this.drag) return;
    if (this.distance?.epoch !== this.epoch) {
      this.begin();
      this.pose.pins = [];
      this.distance = { pose: this.pose.pose, factor: 1, timer: 0, epoch: this.epoch };
    }
    const { distance } = this;
    distance.factor *= factor;
    clearTimeout(distance.timer);
    distance.timer = window.setTimeout(async () => {
      if (distance === this.distance) this.distance = null;
      await this.overlaying;
      if (distance.epoch === this.epoch) await this.measure();
    }, PAUSE);
    const gesture = { kind: "distance" as const, start: at, end: at, factor: distance.factor };
    void this.requestOverlay({ pose: distance.pose, gesture });
  }

  private async localize(anywhere: boolean): Promise<void> {
    if (this.fixed || !this.station.legs) return;
    const { epoch } = this;
    await this.overlaying;
    if (epoch !== this.epoch) return;
    this.notify("Localizing …");
    this.measuring += 1;
    this.fitButton.disabled = this.searchButton.disabled = true;
    // the joints are evidence, beside the pose as the hand set it before them
    const { pins, unpinned, pose } = this.pose;
    const body = this.request({ anywhere, pins, pose: pins.length ? unpinned : pose });
    const answer = await this.query<LocalizationAnswer>("localize", body);
    this.measuring -= 1;
    this.showState();
    if (!answer || epoch !== this.epoch) return;
    if (answer.localized) {
      this.begin();
      this.pose.pins = [];
      this.draw(answer.overlay);
    }
    this.notify(answer.text, answer.localized ? "good" : "bad");
    this.offer(answer.places);
    await this.measure();
  }

  private async save(): Promise<void> {
    const { s, k, pose } = this;
    await this.overlaying;
    const written = pose.pose;
    const body = this.request({ machine: "nominal", pose: written }, s, k);
    const answer = await this.post<SavedAnswer>("save", body);
    if ("message" in answer) return this.notify(answer.message, "bad");
    pose.saved(written);
    this.notify(answer.text, "good");
    this.showState();
  }

  // ---------------------------------------------------------------- keys and faults

  private listen(): void {
    addEventListener("keydown", (event) => {
      const target = event.target as Element;
      if ((event.ctrlKey || event.metaKey) && !event.shiftKey && event.key.toLowerCase() === "z") {
        event.preventDefault();
        this.undo();
        return;
      }
      if (event.ctrlKey || event.metaKey || event.altKey || target.closest?.("canvas, input")) return;
      const middle: Pixel = [(this.image.width - 1) / 2, (this.image.height - 1) / 2];
      const actions: Record<string, () => void> = {
        ArrowUp: () => this.go(this.s - 1, 0),
        ArrowDown: () => this.go(this.s + 1, 0),
        PageUp: () => this.changeDistance(DISTANCE_STEP, middle),
        PageDown: () => this.changeDistance(1 / DISTANCE_STEP, middle),
        f: () => void this.localize(false),
      };
      const action = actions[event.key];
      if (action) action();
      else if (!this.inspector.key(event.key)) return;
      event.preventDefault();
    });
    addEventListener("beforeunload", (event) => {
      if (this.poses.some((pose) => pose.changed)) event.preventDefault();
    });
    // the first image precedes the thumbnails; one that does not come has its reason in words
    this.inspector.element.addEventListener("load", () => this.list.load(), { capture: true, once: true });
    this.inspector.element.addEventListener("error", () => {
      this.list.load();
      const { image } = this;
      const fault = (answer: { message?: string } | null): void => {
        if (image === this.image) this.notify(answer?.message ?? "The image cannot be loaded.", "bad");
      };
      fetch(image.url).then((response) => response.json() as Promise<{ message?: string }>)
        .then(fault, () => fault(null));
    }, true);
  }
}

function legend(): HTMLElement {
  const item = (kind: string, text: string): HTMLElement =>
    h("li", {}, h("span", { class: `session-line line-${kind}` }), text);
  return h("ul", { class: "session-legend small" }, item("machine", "the machine laid over"),
    item("edges", "measured edges"), item("unused", "not in use"), item("missing", "not measured"));
}
