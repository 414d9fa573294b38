/**
 * Inspector of an image with its overlays: zoom about the pointer to single pixels, by wheel, pinch
 * or keys; layers that can be switched off; brightness; the strip of a chosen edge.
 */

import "./inspector.css";
import type { Image, Layer } from "./document";
import { h, number } from "./dom";
import { cameraPixel, hrefOf, imageSvg, replaceLayers, scaleMarks, uprightSize } from "./overlay";
import type { Key } from "./selection";
import { stripPanel } from "./strips";
import { applyExponent, EXPONENTS, startExponent } from "./tones";

const LARGEST_PIXEL = 80; // screen pixels for one of the image
const SMOOTH_BELOW = 3; // likewise; above it pixels have edges
const KEY_ZOOM = 1.4;
const KEY_PAN = 0.15; // of the window

const CLICK_DISTANCE = 4; // screen pixels that a pointer may move between down and up

export type Pixel = [number, number];
/** What a drag does in place of moving the image; pixels are the camera's. */
export interface DragTool {
  /** Whether the drag that begins here is the tool's; scale: screen pixels for one of the image. */
  start: (at: Pixel, scale: number, event: PointerEvent) => boolean;
  move: (at: Pixel, event: PointerEvent) => void;
  /** cancelled: by a second finger, or by the browser. */
  end: (cancelled: boolean) => void;
}

/** Titles and keys of the layers. */
const LAYERS: Record<Layer["name"], { title: string; key: string }> = {
  machine: { title: "Machine", key: "m" },
  edges: { title: "Edges", key: "e" },
  rejected: { title: "Not used", key: "u" },
  joints: { title: "Joints", key: "j" },
  nominal: { title: "Nominal", key: "n" },
  corners: { title: "Corners", key: "c" },
  residuals: { title: "Residuals", key: "r" },
};
type LayerName = keyof typeof LAYERS;

export class Inspector {
  readonly element: HTMLElement;
  private readonly host = h("div", { class: "inspected" });
  private readonly tip = h("div", { class: "inspector-tip", hidden: true });
  private readonly strip = h("div");
  private readonly strips: HTMLElement;
  private readonly choices = h("span", { class: "inspector-choices" });
  private readonly layers = h("span", { class: "inspector-choices" });
  private readonly gamma: HTMLInputElement;
  private gammaChosen = false; // by the reader, for all images
  private readonly where = h("span", { class: "inspector-where" });
  private image: Image | null = null;
  private picture: SVGSVGElement | null = null;
  private overlay = 0;
  /** Index of the strip that is shown, -1 for none. */
  private chosen = -1;
  private readonly off = new Set<LayerName>();
  private dragging = false; // by the tool
  private readonly pointers = new Map<number, { x: number; y: number }>();
  private size = { x: 0, y: 0, width: 1, height: 1 };
  /** Image pixel at the window's middle, and screen pixels for one of the image. */
  private view = { x: 0, y: 0, scale: 1 };

  /**
   * step : shows the image before (-1) or the next one (1).
   * follow : shows the image of a key, to which an arrow leads.
   * tool : of drags with the main button.
   */
  constructor(
    private readonly step: (by: number) => void,
    private readonly follow: (key: Key) => void,
    private readonly tool: DragTool | null = null,
  ) {
    this.gamma = h("input", {
      type: "range", ...EXPONENTS, value: 1, "aria-label": "Brightness of the dark parts",
      oninput: () => {
        this.gammaChosen = true;
        void this.brighten();
      },
    });
    const button = (text: string, label: string, act: () => void): HTMLElement =>
      h("button", { type: "button", "aria-label": label, title: label, onclick: act }, text);
    this.strips = button("Strip", "Strip along the next edge (x), or of the edge that is clicked", () => this.nextStrip());
    this.element = h(
      "div",
      { class: "inspector", tabindex: -1 },
      this.host,
      this.where,
      this.tip,
      this.strip,
      h(
        "div",
        { class: "inspector-bar" },
        button("←", "Image before (←)", () => this.step(-1)),
        button("→", "Next image (→)", () => this.step(1)),
        button("−", "Smaller (−)", () => this.zoom(1 / KEY_ZOOM)),
        button("+", "Larger (+)", () => this.zoom(KEY_ZOOM)),
        button("Whole", "Whole image (0)", () => this.fit()),
        this.choices,
        this.layers,
        this.strips,
        h("label", { class: "inspector-gamma" }, "Dark parts", this.gamma),
      ),
    );
    this.listen();
  }

  /** Show an image; choice of the overlay, layers and a chosen brightness stay as they were. */
  show(image: Image): void {
    this.image = image;
    this.size = { x: -0.5, y: -0.5, ...uprightSize(image) };
    this.chooseStrip(-1);
    this.replaceOverlay(Math.min(this.overlay, Math.max(image.overlays.length - 1, 0)));
    this.fit();
  }

  /** Replace the shapes over the image; zoom, layers and brightness stay. */
  setOverlays(overlays: Image["overlays"]): void {
    if (!this.image || !this.picture) return;
    this.image = { ...this.image, overlays };
    replaceLayers(this.picture, this.image, this.overlay);
    scaleMarks(this.picture, 1 / this.view.scale);
    this.addLayers(overlays[this.overlay]?.layers ?? []);
  }

  /** Draw the image with one of its overlays. */
  private replaceOverlay(overlay: number): void {
    const { image } = this;
    if (!image) return;
    this.overlay = overlay;
    const picture = imageSvg(image, overlay);
    this.picture = picture;
    picture.setAttribute("preserveAspectRatio", "xMidYMid meet");
    this.host.replaceChildren(picture);
    this.strips.hidden = !image.strips.length;
    this.choices.replaceChildren(...(image.overlays.length < 2 ? [] : image.overlays.map(({ title }, k) =>
      h("button", {
        type: "button", title: "Key o", "aria-pressed": String(k === overlay), onclick: () => {
          this.replaceOverlay(k);
          this.draw();
        },
      }, title))));
    this.layers.replaceChildren();
    this.addLayers(image.overlays[overlay]?.layers ?? []);
    void this.brighten();
    this.markStrip();
    this.keepFocus();
  }

  /** Take the focus that a button had which is gone, so that keys keep their meaning. */
  private keepFocus(): void {
    const focused = document.activeElement as HTMLElement | null;
    if (!focused || focused === document.body || focused.hidden) this.element.focus({ preventScroll: true });
  }

  /** Show the strip of an edge below the image, none for an index without one. */
  private chooseStrip(index: number): void {
    const { image } = this;
    if (!image) return;
    this.chosen = index >= 0 && index < image.strips.length ? index : -1;
    this.strip.replaceChildren(...(this.chosen < 0 ? [] : [stripPanel(image, index)]));
    this.markStrip();
    this.keepFocus();
  }

  private markStrip(): void {
    this.picture?.querySelectorAll<SVGElement>("[data-strip]").forEach((edge) => {
      edge.classList.toggle("chosen-strip", Number(edge.dataset.strip) === this.chosen);
    });
  }

  /** The whole image in the window. */
  fit(): void {
    const { x, y, width, height } = this.size;
    this.view = { x: x + width / 2, y: y + height / 2, scale: this.smallest() };
    this.draw();
  }

  /** Act on a key; false for one without a meaning. */
  key(name: string): boolean {
    const pans: Record<string, [number, number]> = {
      ArrowUp: [0, -1], ArrowDown: [0, 1], a: [-1, 0], d: [1, 0], w: [0, -1], s: [0, 1],
    };
    const layer = (Object.keys(LAYERS) as LayerName[]).find((one) => LAYERS[one].key === name);
    if (name === "ArrowLeft" || name === "ArrowRight") this.step(name === "ArrowLeft" ? -1 : 1);
    else if (name === "+" || name === "=") this.zoom(KEY_ZOOM);
    else if (name === "-") this.zoom(1 / KEY_ZOOM);
    else if (name === "0") this.fit();
    else if (name === "o" && this.image && this.image.overlays.length > 1) {
      this.replaceOverlay((this.overlay + 1) % this.image.overlays.length);
      this.draw();
    } else if (name === "x" && this.image?.strips.length) this.nextStrip();
    else if (pans[name]) {
      const { width, height } = this.host.getBoundingClientRect();
      this.view.x += (pans[name][0] * KEY_PAN * width) / this.view.scale;
      this.view.y += (pans[name][1] * KEY_PAN * height) / this.view.scale;
      this.draw();
    } else if (layer) this.toggle(layer);
    else return false;
    return true;
  }

  private smallest(): number {
    const box = this.host.getBoundingClientRect();
    return Math.min(box.width / this.size.width, box.height / this.size.height) || 1;
  }

  /** Zoom by a factor about a point of the window, its middle by default. */
  private zoom(factor: number, at?: { x: number; y: number }): void {
    const box = this.host.getBoundingClientRect();
    const [dx, dy] = at
      ? [at.x - box.left - box.width / 2, at.y - box.top - box.height / 2]
      : [0, 0];
    const scale = Math.min(Math.max(this.view.scale * factor, this.smallest()), LARGEST_PIXEL);
    this.view.x += dx / this.view.scale - dx / scale;
    this.view.y += dy / this.view.scale - dy / scale;
    this.view.scale = scale;
    this.draw();
  }

  private draw(): void {
    if (!this.picture) return;
    const box = this.host.getBoundingClientRect();
    const [width, height] = [box.width / this.view.scale, box.height / this.view.scale];
    // the image stays in the window, in its middle where it is smaller
    const inside = (at: number, low: number, size: number, visible: number): number =>
      visible >= size ? low + size / 2 : Math.min(Math.max(at, low + visible / 2), low + size - visible / 2);
    this.view.x = inside(this.view.x, this.size.x, this.size.width, width);
    this.view.y = inside(this.view.y, this.size.y, this.size.height, height);
    this.picture.setAttribute(
      "viewBox",
      [this.view.x - width / 2, this.view.y - height / 2, width, height].join(" "),
    );
    scaleMarks(this.picture, 1 / this.view.scale);
    this.host.classList.toggle("pixels", this.view.scale > SMOOTH_BELOW);
    this.where.textContent = `${number(this.view.scale, this.view.scale < 10 ? 1 : 0)}×`;
  }

  /** Show the tones that were chosen, or with which the image starts. */
  private async brighten(): Promise<void> {
    const background = this.picture?.querySelector("image");
    if (!this.image || !background) return;
    const start = await startExponent(hrefOf(this.image));
    if (!background.isConnected) return;
    if (!this.gammaChosen) this.gamma.value = String(start);
    applyExponent(background, this.gamma.valueAsNumber);
  }

  /** Buttons of layers that have none yet. */
  private addLayers(layers: Layer[]): void {
    const own = [...this.layers.children].map((button) => (button as HTMLElement).dataset.layer);
    this.layers.append(
      ...layers.filter((layer) => layer.shapes.length && !own.includes(layer.name)).map(({ name }) =>
        h("button", {
          type: "button", "data-layer": name, title: `Key ${LAYERS[name].key}`, onclick: () => this.toggle(name),
        }, LAYERS[name].title)),
    );
    this.applyLayers();
  }

  private toggle(name: LayerName): void {
    if (!this.off.delete(name)) this.off.add(name);
    this.applyLayers();
  }

  private applyLayers(): void {
    for (const layer of this.picture?.querySelectorAll<SVGElement>("[data-layer]") ?? []) {
      layer.style.display = this.off.has(layer.dataset.layer as LayerName) ? "none" : "";
    }
    for (const button of this.layers.querySelectorAll<HTMLElement>("[data-layer]")) {
      button.setAttribute("aria-pressed", String(!this.off.has(button.dataset.layer as LayerName)));
    }
  }

  private nextStrip(): void {
    this.chooseStrip(this.chosen + 1);
  }

  /** Shape of the overlay under the pointer. */
  private shapeAt(event: PointerEvent): SVGElement | null {
    const under = document.elementFromPoint(event.clientX, event.clientY);
    return under?.closest<SVGElement>(".inspected .shape") ?? null;
  }

  private listen(): void {
    const { host, pointers } = this;
    host.addEventListener("wheel", (event) => {
      event.preventDefault();
      const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 24 : 1;
      this.zoom(Math.exp(-0.002 * lines * event.deltaY), { x: event.clientX, y: event.clientY });
    }, { passive: false });
    host.addEventListener("dblclick", (event) => {
      this.zoom(KEY_ZOOM ** 3, { x: event.clientX, y: event.clientY });
    });
    let down = { x: 0, y: 0 };
    host.addEventListener("pointerdown", (event) => {
      down = { x: event.clientX, y: event.clientY };
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      host.setPointerCapture(event.pointerId);
      if (this.dragging) this.endDrag(true); // a second finger: both zoom
      else if (pointers.size === 1 && event.button === 0 && this.tool) {
        this.dragging = this.tool.start(this.pixelAt(event), this.view.scale, event);
      }
    });
    host.addEventListener("pointerup", (event) => {
      pointers.delete(event.pointerId);
      if (this.dragging) return this.endDrag(false);
      if (Math.hypot(event.clientX - down.x, event.clientY - down.y) > CLICK_DISTANCE) return;
      const { strip, key } = this.shapeAt(event)?.dataset ?? {};
      if (strip !== undefined) this.chooseStrip(Number(strip));
      else if (key?.startsWith("image:")) this.follow(key);
    });
    host.addEventListener("pointerleave", () => {
      this.tip.hidden = true;
    });
    host.addEventListener("pointercancel", (event) => {
      pointers.delete(event.pointerId);
      if (this.dragging) this.endDrag(true);
    });
    host.addEventListener("pointermove", (event) => {
      this.locate(event);
      const last = pointers.get(event.pointerId);
      if (!last) return;
      const now = { x: event.clientX, y: event.clientY };
      pointers.set(event.pointerId, now);
      if (this.dragging) return this.tool?.move(this.pixelAt(event), event);
      const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
      if (other) {
        const distance = (p: { x: number; y: number }): number =>
          Math.hypot(p.x - other.x, p.y - other.y);
        this.zoom(distance(now) / Math.max(distance(last), 1), {
          x: (now.x + other.x) / 2, y: (now.y + other.y) / 2,
        });
      }
      const share = other ? 0.5 : 1; // of two fingers, each moves the middle by half
      this.view.x -= (share * (now.x - last.x)) / this.view.scale;
      this.view.y -= (share * (now.y - last.y)) / this.view.scale;
      this.draw();
    });
    // a frame later: what is drawn may change the size of the bar, and with it that of the window
    new ResizeObserver(() => requestAnimationFrame(() => {
      this.view.scale = Math.max(this.view.scale, this.smallest());
      this.draw();
    })).observe(host);
  }

  private endDrag(cancelled: boolean): void {
    this.dragging = false;
    this.tool?.end(cancelled);
  }

  /** Camera's pixel under the pointer; pixel centres are at integers. */
  private pixelAt(event: PointerEvent): Pixel {
    const box = this.host.getBoundingClientRect();
    const x = this.view.x + (event.clientX - box.left - box.width / 2) / this.view.scale;
    const y = this.view.y + (event.clientY - box.top - box.height / 2) / this.view.scale;
    return this.image ? cameraPixel(this.image, x, y) : [x, y];
  }

  /** Coordinates and explanation of what is under the pointer. */
  private locate(event: PointerEvent): void {
    const box = this.host.getBoundingClientRect();
    const [u, v] = this.pixelAt(event);
    const scale = number(this.view.scale, this.view.scale < 10 ? 1 : 0);
    this.where.textContent = `x ${number(u, 1)}, y ${number(v, 1)} px · ${scale}×`;
    const text = this.pointers.size ? "" : this.shapeAt(event)?.dataset.tip;
    this.tip.hidden = !text;
    this.tip.textContent = text ?? "";
    const left = Math.min(event.clientX - box.left + 14, box.width - this.tip.offsetWidth - 4);
    this.tip.style.transform = `translate(${Math.max(left, 4)}px, ${event.clientY - box.top + 14}px)`;
  }
}
