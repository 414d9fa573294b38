/** Labels of points in space: HTML over the canvas, none over another. */

import type { Camera, Vector3 } from "three";
import { h } from "../dom";

export interface Label {
  text: string;
  className: string;
  /** Where it may stand, best first. */
  places: Vector3[];
  /** Whether it stands at the border, with an arrow, where its place is out of view. */
  atBorder?: boolean;
}

interface Box {
  left: number;
  top: number;
  right: number;
  bottom: number;
  /** Direction of the place, if that is out of view. */
  arrow?: string;
}

const GAP = 2;
const ARROWS = ["→", "↘", "↓", "↙", "←", "↖", "↑", "↗"];
const ARROW_WIDTH = 16;

export class Labels {
  readonly layer = h("div", { class: "labels", "aria-hidden": "true" });
  private elements: { element: HTMLElement; label: Label; width: number; height: number }[] = [];

  /** Other labels; those that come first have the choice of places. */
  replace(labels: Label[]): void {
    const same =
      labels.length === this.elements.length &&
      labels.every((label, k) => {
        const { label: old } = this.elements[k];
        return old.text === label.text && old.className === label.className;
      });
    if (same) {
      labels.forEach((label, k) => (this.elements[k].label = label));
      return;
    }
    this.elements = labels.map((label) => {
      const element = h("span", { class: label.className }, label.text);
      return { element, label, width: 0, height: 0 };
    });
    this.layer.replaceChildren(...this.elements.map((one) => one.element));
  }

  /** Place all labels; one for which there is no room is hidden. */
  place(camera: Camera, width: number, height: number): void {
    const taken: Box[] = [];
    for (const one of this.elements) {
      if (!one.width) {
        one.width = one.element.offsetWidth;
        one.height = one.element.offsetHeight;
      }
      const box = one.label.places
        .map((place) => screen(place, camera, width, height, one))
        .find((candidate) => candidate && !taken.some((other) => overlap(candidate, other)));
      one.element.style.visibility = box ? "visible" : "hidden";
      if (!box) continue;
      one.element.dataset.arrow = box.arrow ?? "";
      taken.push(box);
      one.element.style.transform = `translate(${box.left}px, ${box.top}px)`;
    }
  }
}

function screen(
  place: Vector3,
  camera: Camera,
  width: number,
  height: number,
  size: { width: number; height: number; label: Label },
): Box | undefined {
  const p = place.clone().project(camera);
  const { atBorder } = size.label;
  if (p.z > 1 && !atBorder) return undefined;
  const side = p.z > 1 ? -1 : 1; // a point behind the eye is projected to the opposite side
  const x = ((side * p.x + 1) / 2) * width - size.width / 2;
  const y = ((1 - side * p.y) / 2) * height - size.height / 2;
  const inside = p.z <= 1 && x >= 0 && y >= 0 && x + size.width <= width && y + size.height <= height;
  if (!inside && !atBorder) return undefined;
  const extra = inside ? 0 : ARROW_WIDTH;
  const left = Math.round(Math.min(Math.max(x, 0), width - size.width - extra));
  const top = Math.round(Math.min(Math.max(y, 0), height - size.height));
  const box = { left, top, right: left + size.width + extra, bottom: top + size.height };
  if (inside) return box;
  const angle = Math.atan2(y - height / 2, x - width / 2);
  return { ...box, arrow: ARROWS[(Math.round(angle / (Math.PI / 4)) + 8) % 8] };
}

function overlap(a: Box, b: Box): boolean {
  return (
    a.left < b.right + GAP && b.left < a.right + GAP && a.top < b.bottom + GAP && b.top < a.bottom + GAP
  );
}
