/** An image with its overlay as SVG, upright, in pixels of the camera. */

import "./overlay.css";
import type { Image, Layer } from "./document";
import { svg } from "./dom";
import { toBlobUrl } from "./image_data";
import { keyClass } from "./marks";

type Shape = Layer["shapes"][number];
const ARROW_HEAD = 5; // units of a mark

/** Size of the image as it is shown, px. */
export function uprightSize(image: Image): { width: number; height: number } {
  const { width, height } = image;
  return image.quarter_turns % 2 ? { width: height, height: width } : { width, height };
}

/** Entries a, b, c, d, e, f of the transformation from the camera's pixels to upright ones. */
function uprightMatrix({ quarter_turns, width, height }: Image): number[] {
  switch (quarter_turns % 4) {
    case 1: return [0, 1, -1, 0, height - 1, 0];
    case 2: return [-1, 0, 0, -1, width - 1, height - 1];
    case 3: return [0, -1, 1, 0, 0, width - 1];
    default: return [1, 0, 0, 1, 0, 0];
  }
}

/** Camera's pixel of an upright one. */
export function cameraPixel(image: Image, x: number, y: number): [number, number] {
  const [a, b, c, d, e, f] = uprightMatrix(image);
  return [a * (x - e) + b * (y - f), c * (x - e) + d * (y - f)]; // a rotation: transposed
}

/** Address of an image; empty if it could not be read. */
export const hrefOf = (image: Image): string => image.url || (image.webp && toBlobUrl(image.webp));

/** Image with one of its overlays, none for an index without one. */
export function imageSvg(image: Image, overlay = 0): SVGSVGElement {
  const { width, height } = uprightSize(image);
  const frame = { x: -0.5, y: -0.5, width: image.width, height: image.height };
  const href = hrefOf(image);
  const background = href
    ? svg("image", { ...frame, preserveAspectRatio: "none", href })
    : svg("rect", { ...frame, class: "absent" });
  const picture = svg("svg", {
    class: "shot", role: "img", viewBox: `-0.5 -0.5 ${width} ${height}`,
    "aria-label": [image.title, image.caption].filter(Boolean).join(": "),
  }, svg("g", { transform: `matrix(${uprightMatrix(image).join(" ")})` },
    background, svg("g", { class: "overlay" })));
  replaceLayers(picture, image, overlay);
  scaleMarks(picture, width / 660);
  return picture;
}

/** Draw an overlay in place of the one before; its marks need `scaleMarks`. */
export function replaceLayers(picture: SVGSVGElement, image: Image, overlay: number): void {
  const layers = image.overlays[overlay]?.layers ?? [];
  picture.querySelector(".overlay")?.replaceChildren(...layers.map((layer) => layerGroup(layer, image)));
}

/** Give rings, crosses and arrowheads their size: image pixels for one of their units. */
export function scaleMarks(picture: SVGSVGElement, unit: number): void {
  for (const mark of picture.querySelectorAll<SVGElement>(".mark")) {
    mark.setAttribute("transform", `${mark.dataset.place} scale(${unit})`);
  }
}

function layerGroup(layer: Layer, image: Image): SVGElement {
  const halo = layer.name === "edges" || layer.name === "machine" ? [svg("path", { class: "halo", d: layer.shapes.map(pathData).join("") })] : [];
  return svg("g", { class: `layer ${layer.name}`, "data-layer": layer.name },
    ...halo, ...layer.shapes.map((shape) => shapeGroup(shape, layer, image)));
}

function pathData(shape: Shape): string {
  return shape.shape === "polyline" ? `M${shape.points.map((p) => p.join(",")).join("L")}` : "";
}

function shapeGroup(shape: Shape, layer: Layer, image: Image): SVGElement {
  const group = svg("g", { class: ["shape", keyClass(shape.key ?? ""), dashed(shape) ? "dashed" : ""].filter(Boolean).join(" ") });
  if (shape.key) group.dataset.key = shape.key;
  if (shape.tip) group.dataset.tip = shape.tip;
  const mark = (at: [number, number], turn: number, ...children: Node[]): SVGElement =>
    svg("g", { class: "mark", "data-place": `translate(${at[0]} ${at[1]}) rotate(${turn})` }, ...children);
  const upright = -90 * image.quarter_turns;
  switch (shape.shape) {
    case "polyline": {
      const d = pathData(shape);
      if (shape.strip != null) group.dataset.strip = String(shape.strip);
      group.append(svg("path", { class: "hit", d }), svg("path", { class: "line", d }));
      break;
    }
    case "ring": {
      const r = layer.name === "corners" ? 3 : 6;
      const ring = mark(shape.at, upright, svg("circle", { class: "halo", r }),
        svg("circle", { class: shape.filled ? "line filled" : "line", r }));
      if (shape.label) {
        const label = svg("text", { x: 8.4, y: 14.4 });
        label.textContent = shape.label;
        ring.append(label);
      }
      group.append(ring);
      break;
    }
    case "cross":
      group.append(mark(shape.at, upright, svg("path", { class: "line", d: "M-4.5,-4.5l9,9m0,-9l-9,9" })));
      break;
    case "arrow": {
      const [x, y] = shape.at;
      const [dx, dy] = shape.displacement.map((one) => one * layer.enlargement);
      const turn = (Math.atan2(dy, dx) * 180) / Math.PI;
      const d = `M${x},${y}l${dx},${dy}`;
      const head = `M${-ARROW_HEAD},${-0.5 * ARROW_HEAD}L0,0L${-ARROW_HEAD},${0.5 * ARROW_HEAD}`;
      group.append(svg("path", { class: "hit", d }), svg("path", { class: "line", d }),
        mark([x + dx, y + dy], turn, svg("path", { class: "line", d: head })));
      if (shape.label) {
        const label = svg("text", { x: 8, y: 5 });
        label.textContent = shape.label;
        group.append(mark([x + dx, y + dy], upright, label));
      }
    }
  }
  return group;
}

const dashed = (shape: Shape): boolean => "dashed" in shape && shape.dashed === true;
