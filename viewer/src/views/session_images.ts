/** Thumbnails of a session's images by station, each with the mark of whether it fits. */

import type { SessionDocument } from "../document";
import { h } from "../dom";
import { type Mark, sign } from "../marks";
import { uprightSize } from "../overlay";
import { startTones } from "../tones";

const COUNTED: Mark[] = ["good", "doubtful", "wrong"];

/** Mark of an image; null where nothing can be compared, undefined before it is measured. */
export type ImageMark = Mark | null | undefined;

export class ImageList {
  readonly element = h("nav", { class: "session-images", "aria-label": "Images" });
  private readonly buttons: HTMLButtonElement[][];
  private readonly counts: HTMLElement[] = [];
  private marks: ImageMark[][] = [];

  constructor({ stations }: SessionDocument, choose: (s: number, k: number) => void) {
    this.buttons = stations.map((station, s) => station.images.map((image, k) => {
      const { width, height } = uprightSize(image);
      const picture = h("img", {
        "data-src": image.url.replace("image", "thumbnail"), alt: "", loading: "lazy", width, height,
        onload: () => void startTones(picture, picture.src),
        onerror: () => picture.removeAttribute("src"), // its mark and its image say why
      });
      return h("button", { type: "button", title: image.title, onclick: () => choose(s, k) },
        picture, h("span", { class: "session-name" }, h("span", { class: "session-mark" }), image.caption));
    }));
    stations.forEach((station, s) => {
      this.counts.push(h("span", { class: "session-counts" }));
      this.element.append(h("section", { "aria-label": station.name },
        h("h2", {}, station.name, " ", this.counts[s]),
        ...(station.handheld ? [h("p", { class: "small" }, "by hand")] : []),
        h("ol", {}, ...this.buttons[s].map((button) => h("li", {}, button)))));
    });
  }

  /** Request the thumbnails as they come into view. */
  load(): void {
    for (const picture of this.element.querySelectorAll<HTMLImageElement>("[data-src]")) {
      picture.src = picture.dataset.src ?? "";
      delete picture.dataset.src;
    }
  }

  select(s: number, k: number): void {
    this.buttons.flat().forEach((button) => button.removeAttribute("aria-current"));
    const button = this.buttons[s][k];
    button.setAttribute("aria-current", "true");
    button.scrollIntoView({ block: "nearest", inline: "nearest" });
  }

  /** Show other marks of all images; the array is kept, and changed by `set`. */
  show(marks: ImageMark[][]): void {
    this.marks = marks;
    marks.forEach((some, s) => this.buttons[s].forEach((_button, k) => this.draw(s, k, some[k])));
    marks.forEach((_some, s) => this.count(s));
  }

  set(s: number, k: number, mark: ImageMark): void {
    this.marks[s][k] = mark;
    this.draw(s, k, mark);
    this.count(s);
  }

  private draw(s: number, k: number, mark: ImageMark): void {
    this.buttons[s][k].querySelector(".session-mark")?.replaceChildren(...(mark ? [sign(mark), " "] : []));
  }

  private count(s: number): void {
    const own = COUNTED.map((mark) => [mark, this.marks[s].filter((one) => one === mark).length] as const);
    this.counts[s].replaceChildren(...own.flatMap(([mark, n]) => (n ? [sign(mark), ` ${n} `] : [])));
  }
}
