/** Dialog with the inspector, shared by all images of a page. */

import type { Image } from "./document";
import { h } from "./dom";
import { Inspector } from "./inspector";
import { type Key, matches, type Selection } from "./selection";

/** Images of one block; `open` shows one of them. */
interface ImageBlock {
  element: HTMLElement;
  images: Image[];
  open: (image: Image) => void;
}

export class ImageViewer {
  readonly dialog: HTMLDialogElement;
  private readonly caption = h("p", { class: "inspector-caption" });
  private readonly inspector = new Inspector((by) => this.show(this.current + by), (key) => this.openKey(key));
  private readonly blocks: ImageBlock[] = [];
  /** Images that the inspector walks through. */
  private images: Image[] = [];
  private current = 0;

  constructor(selection: Selection) {
    const close = h("button", { type: "button", class: "inspector-close", "aria-label": "Close", onclick: () => this.dialog.close() }, "×");
    this.dialog = h("dialog", { class: "inspector-dialog", "aria-label": "Image" }, this.caption, close, this.inspector.element);
    this.dialog.addEventListener("close", () => selection.choose(null));
    this.dialog.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const slides = event.target instanceof HTMLInputElement && event.key.startsWith("Arrow");
      if (!slides && this.inspector.key(event.key)) event.preventDefault();
    });
    this.dialog.addEventListener("click", (event) => {
      if (event.target === this.dialog) this.dialog.close();
    });
    // the image of a chosen key, of the first block that is in view; a hover changes nothing
    let before: Key | null = null;
    selection.subscribe((_, chosen) => {
      if (chosen === before) return;
      before = chosen;
      if (!chosen || !/^(image|configuration):/.test(chosen)) return;
      this.openKey(chosen, this.blocks.filter((block) => !block.element.closest("details:not([open])")));
    });
  }

  add(block: ImageBlock): void {
    this.blocks.push(block);
  }

  /** Image with exactly this key, of the first block that has one. */
  find(key: Key): Image | undefined {
    return this.blocks.flatMap((block) => block.images).find((image) => image.key === key);
  }

  /** Open the image that belongs to a key, of the first block that has one. */
  openKey(key: Key, blocks = this.blocks): void {
    for (const block of blocks) {
      const image = block.images.find((one) => matches(one.key, key));
      if (image) return block.open(image);
    }
  }

  /** Open an image, one of those to walk through. */
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
