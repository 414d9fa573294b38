/**
 * Inspector of an image with its overlay, an SVG in the image's pixels: zoom about the pointer to
 * single pixels, by wheel, pinch or keys; layers that can be switched off; brightness.
 */

import { h, number } from "./dom";

const LARGEST_PIXEL = 80; // screen pixels for one of the image
const SMOOTH_BELOW = 3; // likewise; above it pixels have edges
const KEY_ZOOM = 1.4;
const KEY_PAN = 0.15; // of the window

/** Layers of the overlay, by the classes of their shapes, with their key. */
const LAYERS = [
  { name: "Edges", key: "e", shapes: ".edge, path.halo" },
  { name: "Not used", key: "u", shapes: ".missed" },
  { name: "Joints", key: "j", shapes: ".spot .ring, .spot .halo, .spot text" },
  { name: "Nominal", key: "n", shapes: ".spot .cross" },
  { name: "Corners", key: "c", shapes: ".seen" },
  { name: "Residuals", key: "r", shapes: ".arrow" },
] as const;

export class Inspector {
  readonly element: HTMLElement;
  private readonly host = h("div", { class: "inspected" });
  private readonly layers = h("span", { class: "inspector-layers" });
  private readonly gamma: HTMLInputElement;
  private readonly where = h("output", { class: "inspector-where" });
  private picture: SVGSVGElement | null = null;
  private curve: SVGElement[] = [];
  private readonly off = new Set<string>();
  private readonly pointers = new Map<number, { x: number; y: number }>();
  private size = { x: 0, y: 0, width: 1, height: 1 };
  /** Image pixel at the window's middle, and screen pixels for one of the image. */
  private view = { x: 0, y: 0, scale: 1 };

  /** step : shows the image before (-1) or the next one (1). */
  constructor(private readonly step: (by: number) => void) {
    this.gamma = h("input", {
      type: "range", min: 0.2, max: 1.8, step: 0.05, value: 1, "aria-label": "Brightness of the dark parts",
      oninput: () => this.brighten(),
    });
    const button = (text: string, label: string, act: () => void): HTMLElement =>
      h("button", { type: "button", "aria-label": label, title: label, onclick: act }, text);
    this.element = h(
      "div",
      { class: "inspector" },
      this.host,
      h(
        "div",
        { class: "inspector-bar" },
        button("←", "Image before (←)", () => this.step(-1)),
        button("→", "Next image (→)", () => this.step(1)),
        button("−", "Smaller (−)", () => this.zoom(1 / KEY_ZOOM)),
        button("+", "Larger (+)", () => this.zoom(KEY_ZOOM)),
        button("Whole", "Whole image (0)", () => this.fit()),
        this.layers,
        h("label", { class: "inspector-gamma" }, "Dark parts", this.gamma),
        this.where,
      ),
    );
    this.listen();
  }

  /** Show a picture; layers and brightness stay as they were. */
  show(picture: SVGSVGElement): void {
    this.picture = picture;
    const { x, y, width, height } = picture.viewBox.baseVal;
    this.size = { x, y, width, height };
    picture.setAttribute("preserveAspectRatio", "xMidYMid meet");
    this.host.replaceChildren(picture);
    this.addCurve(picture);
    this.addLayers(picture);
    this.brighten();
    this.fit();
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
    const layer = LAYERS.find((one) => one.key === name);
    if (name === "ArrowLeft" || name === "ArrowRight") this.step(name === "ArrowLeft" ? -1 : 1);
    else if (name === "+" || name === "=") this.zoom(KEY_ZOOM);
    else if (name === "-") this.zoom(1 / KEY_ZOOM);
    else if (name === "0") this.fit();
    else if (pans[name]) {
      const { width, height } = this.host.getBoundingClientRect();
      this.view.x += (pans[name][0] * KEY_PAN * width) / this.view.scale;
      this.view.y += (pans[name][1] * KEY_PAN * height) / this.view.scale;
      this.draw();
    } else if (layer) this.toggle(layer.name);
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
    const inside = (at: number, low: number, size: number, shown: number): number =>
      shown >= size ? low + size / 2 : Math.min(Math.max(at, low + shown / 2), low + size - shown / 2);
    this.view.x = inside(this.view.x, this.size.x, this.size.width, width);
    this.view.y = inside(this.view.y, this.size.y, this.size.height, height);
    this.picture.setAttribute(
      "viewBox",
      [this.view.x - width / 2, this.view.y - height / 2, width, height].join(" "),
    );
    this.host.classList.toggle("pixels", this.view.scale > SMOOTH_BELOW);
    this.where.textContent = `${number(this.view.scale, this.view.scale < 10 ? 1 : 0)}×`;
  }

  /** Filter of the image's tones, inside the picture itself. */
  private addCurve(picture: SVGSVGElement): void {
    const image = picture.querySelector("image");
    if (!image) return;
    const make = (name: string): SVGElement =>
      document.createElementNS(picture.namespaceURI, name) as SVGElement;
    const filter = make("filter");
    filter.id = "inspector-tones";
    filter.setAttribute("color-interpolation-filters", "sRGB");
    const transfer = make("feComponentTransfer");
    this.curve = ["R", "G", "B"].map((channel) => {
      const one = make(`feFunc${channel}`);
      one.setAttribute("type", "gamma");
      return one;
    });
    transfer.append(...this.curve);
    filter.append(transfer);
    picture.prepend(filter);
  }

  private brighten(): void {
    const exponent = this.gamma.value;
    for (const one of this.curve) one.setAttribute("exponent", exponent);
    // without the filter zooming is faster
    const image = this.picture?.querySelector("image");
    if (Number(exponent) === 1) image?.removeAttribute("filter");
    else image?.setAttribute("filter", "url(#inspector-tones)");
  }

  private addLayers(picture: SVGSVGElement): void {
    const present = LAYERS.filter((layer) => picture.querySelector(layer.shapes));
    this.layers.replaceChildren(
      ...present.map(({ name, key }) =>
        h(
          "button",
          { type: "button", "data-layer": name, title: `Key ${key}`, onclick: () => this.toggle(name) },
          name,
        )),
    );
    this.applyLayers();
  }

  private toggle(name: string): void {
    if (!this.off.delete(name)) this.off.add(name);
    this.applyLayers();
  }

  private applyLayers(): void {
    for (const { name, shapes } of LAYERS) {
      this.picture?.querySelectorAll<SVGElement>(shapes).forEach((shape) => {
        shape.style.display = this.off.has(name) ? "none" : "";
      });
      this.layers.querySelector(`[data-layer="${name}"]`)
        ?.setAttribute("aria-pressed", String(!this.off.has(name)));
    }
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
    host.addEventListener("pointerdown", (event) => {
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      host.setPointerCapture(event.pointerId);
    });
    const up = (event: PointerEvent): void => {
      pointers.delete(event.pointerId);
    };
    host.addEventListener("pointerup", up);
    host.addEventListener("pointercancel", up);
    host.addEventListener("pointermove", (event) => {
      this.locate(event);
      const last = pointers.get(event.pointerId);
      if (!last) return;
      const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
      const now = { x: event.clientX, y: event.clientY };
      pointers.set(event.pointerId, now);
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
    new ResizeObserver(() => {
      this.view.scale = Math.max(this.view.scale, this.smallest());
      this.draw();
    }).observe(host);
  }

  /** Coordinates of the pixel under the pointer; pixel centres are at integers. */
  private locate(event: PointerEvent): void {
    const box = this.host.getBoundingClientRect();
    const x = this.view.x + (event.clientX - box.left - box.width / 2) / this.view.scale;
    const y = this.view.y + (event.clientY - box.top - box.height / 2) / this.view.scale;
    const scale = number(this.view.scale, this.view.scale < 10 ? 1 : 0);
    this.where.textContent = `x ${number(x, 1)}, y ${number(y, 1)} px · ${scale}×`;
  }
}
