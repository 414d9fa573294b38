/** Ground below the machine, with a round step. */

import { BufferGeometry, Float32BufferAttribute, LineBasicMaterial, LineSegments } from "three";
import type { Box3 } from "three";
import type { Palette } from "./palette";

const CELLS = 12; // about as many across
const MARGIN = 0.3; // beyond the machine, as a share of its width
const BELOW = 0.004; // likewise, so that it does not lie in the base

/** Largest of 1, 2 and 5 times a power of ten that is not above a length. */
function roundStep(length: number): number {
  const power = 10 ** Math.floor(Math.log10(length));
  const factor = [5, 2, 1].find((one) => one * power <= length * (1 + 1e-9)) ?? 1;
  return factor * power;
}

export class Grid {
  readonly object: LineSegments;
  /** Distance of its lines, m. */
  readonly step: number;

  constructor(box: Box3, palette: Palette) {
    const span = Math.max(box.max.x - box.min.x, box.max.y - box.min.y, 1e-6);
    this.step = roundStep((span * (1 + 2 * MARGIN)) / CELLS * 1.5);
    const limits = (low: number, high: number): [number, number] => [
      Math.floor((low - MARGIN * span) / this.step) * this.step,
      Math.ceil((high + MARGIN * span) / this.step) * this.step,
    ];
    const [x0, x1] = limits(box.min.x, box.max.x);
    const [y0, y1] = limits(box.min.y, box.max.y);
    const z = box.min.z - BELOW * span;
    const ends: number[] = [];
    for (let x = x0; x <= x1 + this.step / 2; x += this.step) ends.push(x, y0, z, x, y1, z);
    for (let y = y0; y <= y1 + this.step / 2; y += this.step) ends.push(x0, y, z, x1, y, z);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new Float32BufferAttribute(ends, 3));
    const material = new LineBasicMaterial({ transparent: true, depthWrite: false });
    this.object = new LineSegments(geometry, palette.paint(material, "--rule"));
  }
}
