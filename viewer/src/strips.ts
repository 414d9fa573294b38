/**
 * Rectified strip of an edge, enlarged across it, with the prediction, the fitted line and its
 * standard deviation.
 */

import "./strips.css";
import type { Image, Layer } from "./document";
import { h, svg } from "./dom";
import { toBlobUrl } from "./image_data";

const ENLARGEMENTS = [8, 64]; // screen pixels for one across the edge

export function stripPanel(image: Image, index: number): HTMLElement {
  const title = tipOf(image, index);
  const host = h("div", { class: "strip-host" });
  const buttons = ENLARGEMENTS.map((factor) =>
    h("button", { type: "button", onclick: () => show(factor) }, `${factor}×`));
  const show = (factor: number): void => {
    host.replaceChildren(stripSvg(image, index, title, factor));
    buttons.forEach((button, k) => button.setAttribute("aria-pressed", String(ENLARGEMENTS[k] === factor)));
  };
  show(ENLARGEMENTS[0]);
  return h("div", { class: "strip" },
    h("p", { class: "strip-title" }, title, " ", ...buttons), host,
    h("p", { class: "strip-key" },
      h("span", { class: "fitted" }), "fitted line ± σ ", h("span", { class: "predicted" }),
      "calibrated machine · outward is up; from the base's end at the left to the platform's. The border in the"
        + " image wanders about the line by a few tenths of a pixel (measured: −0.25 to +0.15 px), because shading"
        + " differs along the tube: that is no error of the fit."));
}

/** Explanation of the edge with a strip. */
function tipOf(image: Image, index: number): string {
  const shapes = image.overlays.flatMap((one) => one.layers).flatMap((layer) => layer.shapes as Layer["shapes"][number][]);
  return shapes.find((one) => one.shape === "polyline" && one.strip === index)?.tip ?? "";
}

function stripSvg(image: Image, index: number, title: string, factor: number): SVGElement {
  const { length, offset, sigma } = image.strips[index];
  const across = image.strip_rows;
  const rows = across * (ENLARGEMENTS[0] / factor);
  const middle = (across - 1) / 2;
  const along = (k: number): number => (k * (length - 1)) / Math.max(offset.length - 1, 1);
  const path = (values: number[]): string => values.map((one, k) => `${along(k)},${middle - one}`).join("L");
  const upper = offset.map((one, k) => one + sigma[k]);
  const lower = offset.map((one, k) => one - sigma[k]);
  const sprite = {
    width: Math.max(...image.strips.map((one) => one.length)),
    height: image.strips.length * across,
  };
  const picture = svg("svg", {
    class: "strip-image", preserveAspectRatio: "none", role: "img", "aria-label": title,
    viewBox: `-0.5 ${middle - rows / 2} ${length} ${rows}`,
  },
    svg("image", {
      x: -0.5, y: -index * across - 0.5, ...sprite, preserveAspectRatio: "none", href: toBlobUrl(image.strip_webp),
    }),
    svg("path", { class: "predicted", d: `M${path(offset.map(() => 0))}` }),
    svg("path", { class: "band", d: `M${path(upper)}L${path(lower).split("L").reverse().join("L")}Z` }),
    svg("path", { class: "fitted", d: `M${path(offset)}` }));
  picture.setAttribute("height", String(across * ENLARGEMENTS[0]));
  return picture;
}
