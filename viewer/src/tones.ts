/**
 * Tones of an image as it is first shown: dark parts are lifted so far that half of the image is at
 * least as light as a grey card in a photograph. No image is made darker.
 */

import { svg } from "./dom";

const GREY_CARD = 0.46; // reflectance of 18 %, in sRGB
const SAMPLES = 64; // pixels across, of the copy that is measured
/** Exponents that can be chosen. */
export const EXPONENTS = { min: 0.2, max: 1.8, step: 0.05 };

const exponents = new Map<string, Promise<number>>();
const known = new Map<string, number>();
const filters = svg("svg", { class: "tones", width: 0, height: 0, "aria-hidden": "true" });

/** Show an image with the exponent with which it starts: at once if that is known, as on paper. */
export async function startTones(image: SVGElement | HTMLElement, href: string): Promise<void> {
  applyExponent(image, known.get(href) ?? (await startExponent(href)));
}

/** Exponent with which an image starts; 1 leaves it as it is. */
export function startExponent(href: string): Promise<number> {
  let exponent = exponents.get(href);
  if (!exponent) {
    exponent = measured(href).catch(() => 1);
    exponents.set(href, exponent);
    void exponent.then((value) => known.set(href, value));
  }
  return exponent;
}

async function measured(href: string): Promise<number> {
  const image = new Image();
  image.src = href;
  await image.decode();
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = SAMPLES;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  if (!context) return 1;
  context.drawImage(image, 0, 0, SAMPLES, SAMPLES);
  const levels = context.getImageData(0, 0, SAMPLES, SAMPLES).data.filter((_, k) => k % 4 === 1).sort();
  const median = Math.max(levels[levels.length >> 1], 1) / 255;
  if (median >= GREY_CARD) return 1;
  const { min, step } = EXPONENTS;
  return Math.min(Math.max(Math.round(Math.log(GREY_CARD) / Math.log(median) / step) * step, min), 1);
}

/** Show an image with an exponent. */
export function applyExponent(image: SVGElement | HTMLElement, exponent: number): void {
  image.style.filter = "";
  if (exponent === 1) return; // without the filter zooming is faster
  const id = `tones-${Math.round(100 * exponent)}`;
  if (!filters.isConnected) document.body.append(filters);
  if (!filters.querySelector(`#${id}`)) {
    filters.append(svg("filter", { id, "color-interpolation-filters": "sRGB" },
      svg("feComponentTransfer", {}, ...(["feFuncR", "feFuncG", "feFuncB"] as const).map((channel) =>
        svg(channel, { type: "gamma", exponent })))));
  }
  image.style.filter = `url(#${id})`;
}
