/** Grid of images with their overlays; each opens in the inspector. */

import "./images.css";
import type { Image, Images } from "../document";
import { h, legClass } from "../dom";
import { Inspector } from "../inspector";
import { imageSvg } from "../overlay";
import { matches } from "../selection";
import type { Context } from "./index";

export function images(block: Images, { selection }: Context): HTMLElement {
  const groups = [...new Set(block.images.map((image) => image.group))].filter(Boolean).sort();
  const grid = h("div", { class: `images ${block.size}` });
  const bar = h("div", { class: "images-bar" });
  const element = h("div", {}, bar, grid);
  let group = "";
  let all = block.images.length <= block.first;
  let viewer: Viewer | null = null;

  const inGroup = (): Image[] => block.images.filter((image) => !group || image.group === group);
  const open = (image: Image): void => {
    viewer ??= new Viewer(element, () => selection.choose(null));
    viewer.open(inGroup().includes(image) ? inGroup() : block.images, image);
  };
  const figure = (image: Image): HTMLElement => {
    const button = h("button", { type: "button", class: "enlarge", title: "Inspect", "aria-label": `Inspect ${image.title}` });
    button.append(imageSvg(image));
    button.addEventListener("click", (event) => {
      // an arrow leads to the image that it belongs to
      const key = (event.target as Element).closest<SVGElement>(".shape")?.dataset.key ?? "";
      if (key.startsWith("image:")) selection.choose(key);
      else open(image);
    });
    return h("figure", image.key ? { "data-key": image.key } : {}, button,
      h("figcaption", {}, h("b", {}, image.title), " ", h("span", { class: "small" }, image.caption)));
  };
  const draw = (): void => {
    const some = inGroup();
    grid.replaceChildren(...(all ? some : some.slice(0, block.first)).map(figure));
    bar.replaceChildren(...legend(block.legs));
    if (groups.length > 1) {
      bar.append(...["", ...groups].map((name) =>
        h("button", {
          type: "button", "aria-pressed": String(name === group), onclick: () => {
            group = name;
            draw();
          },
        }, name || "All")));
    }
    if (some.length > block.first) {
      bar.append(h("button", {
        type: "button", class: "images-all", "aria-pressed": String(all), onclick: () => {
          all = !all;
          draw();
        },
      }, all ? `First ${block.first}` : `All ${some.length} images`));
    }
    bar.hidden = !bar.childElementCount;
  };
  draw();
  selection.subscribe((_, chosen) => {
    if (!chosen || !/^(image|configuration):/.test(chosen)) return;
    const image = block.images.find((one) => matches(one.key, chosen));
    if (image) open(image);
  });
  return element;
}

const legend = (legs: number): HTMLElement[] => legs ? [
  h("span", { class: "images-legs", role: "img", "aria-label": "Colours of the legs" },
    ...Array.from({ length: legs }, (_, j) =>
      h("span", { class: `chip on-image ${legClass(`leg:${j + 1}`)}` }, String(j + 1)))),
] : [];

/** Dialog with the inspector, and the images that it walks through. */
class Viewer {
  private readonly dialog: HTMLDialogElement;
  private readonly caption = h("p", { class: "inspector-caption" });
  private readonly inspector = new Inspector((by) => this.show(this.current + by));
  private images: Image[] = [];
  private current = 0;

  constructor(host: HTMLElement, closed: () => void) {
    const close = h("button", { type: "button", class: "inspector-close", "aria-label": "Close", onclick: () => this.dialog.close() }, "×");
    this.dialog = h("dialog", { class: "inspector-dialog", "aria-label": "Image" }, this.caption, close, this.inspector.element);
    host.append(this.dialog);
    this.dialog.addEventListener("close", closed);
    this.dialog.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const slides = event.target instanceof HTMLInputElement && event.key.startsWith("Arrow");
      if (!slides && this.inspector.key(event.key)) event.preventDefault();
    });
    this.dialog.addEventListener("click", (event) => {
      if (event.target === this.dialog) this.dialog.close();
    });
  }

  open(images: Image[], image: Image): void {
    this.images = images;
    if (!this.dialog.open) this.dialog.showModal();
    this.show(images.indexOf(image));
  }

  private show(k: number): void {
    const n = this.images.length;
    this.current = (k + n) % n;
    const { title, caption } = this.images[this.current];
    this.caption.replaceChildren(h("b", {}, title), ` · ${caption ? `${caption} · ` : ""}${this.current + 1} of ${n}`);
    this.inspector.show(this.images[this.current]);
  }
}
