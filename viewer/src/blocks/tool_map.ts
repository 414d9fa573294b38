/** Block of contour maps of the tool's error: one layer in one slice, drawn as SVG. */

import { contours } from "d3-contour";
import type { MapLayer, MapSlice, ToolMapBlock } from "../document";
import { h, number, svg } from "../dom";
import type { Context } from "./index";
import "./tool_map.css";

const WIDTH = { wide: 640, narrow: 380 }; // of the drawing, in its own units
const LEFT = 58;
const BOTTOM = 44;
const TOP = 12;
const RIGHT = 14;
const LEVELS = 7; // contour lines, about
const WIDE_RANGE = 6; // ratio of the values from which the levels are spaced as their logarithms
const FAINTEST = 6; // per cent of ink of the best band
const DARKEST = 72;
const LABEL_SPACE = 34; // between the labels of contour lines

type Grid = (number | null)[][];
let count = 0;

export function tool_map(block: ToolMapBlock, { selection, printSteps }: Context): HTMLElement {
  const names = [...new Set(block.layers.map((one) => one.name))];
  const components = [...new Set(block.layers.map((one) => one.component))];
  const middle = Math.floor((block.slices.filter((one) => one.normal === block.slices[0].normal).length - 1) / 2);
  const state = { name: names[0], component: components[0], slice: middle };
  // error and standard deviation have one limit, so that their shares compare
  const limitKey = (one: MapLayer): string => `${one.component} ${one.unit || one.name}`;
  const limits = new Map(block.layers.map((one) => [limitKey(one), one.limit]));
  const layer = (): MapLayer =>
    block.layers.find((one) => one.name === state.name && one.component === state.component) ?? block.layers[0];

  const host = h("div", { class: "map-picture" });
  const level = h("output", {});
  const slider = h("input", {
    type: "range", min: 0, max: block.slices.length - 1, step: 1, value: state.slice, "aria-label": "Slice",
    oninput: () => {
      state.slice = slider.valueAsNumber;
      draw();
    },
  });
  const limit = h("input", {
    type: "number", min: 0, step: "any", "aria-label": "Wanted accuracy",
    oninput: () => {
      if (limit.valueAsNumber > 0) limits.set(limitKey(layer()), limit.valueAsNumber);
      draw(false);
    },
  });
  const unit = h("span", {});
  const share = h("output", {});
  const value = h("p", { class: "small map-value" });
  const good = h("span", {});

  const draw = (withLimit = true, width = matchMedia("(max-width: 600px)").matches ? WIDTH.narrow : WIDTH.wide): void => {
    const one = layer();
    const wanted = limits.get(limitKey(one)) ?? one.limit;
    const slice = block.slices[state.slice];
    if (withLimit) limit.value = String(wanted);
    level.textContent = `${slice.normal} = ${number(slice.level, levelDecimals(block, slice))} mm`;
    slider.setAttribute("aria-valuetext", level.textContent);
    good.textContent = one.better === "small" ? "Good to" : "At least";
    unit.textContent = one.unit || "×";
    const within = one.evenly.filter((x) => (one.better === "small" ? x <= wanted : x >= wanted)).length;
    share.textContent = `${number((100 * within) / Math.max(one.evenly.length, 1), 0)} % of the workspace`;
    const { picture, at } = map(slice, one, one.slices[state.slice] as Grid, wanted, block, width);
    picture.addEventListener("pointermove", (event) => (value.textContent = at(event)));
    picture.addEventListener("pointerleave", () => (value.textContent = ""));
    picture.addEventListener("click", (event) => {
      const key = (event.target as Element).closest<SVGElement>("[data-key]")?.dataset.key;
      if (key) selection.choose(key);
    });
    host.replaceChildren(picture);
    selection.apply(host);
  };
  const radio = (label: string, values: string[], current: string, onchange: (one: string) => void): HTMLElement => {
    const group = `map-${(count += 1)}`;
    return h("fieldset", { class: "map-tabs" },
      h("legend", { class: "hidden" }, label),
      ...values.map((text) =>
        h("label", {},
          h("input", { type: "radio", name: group, checked: text === current, onchange: () => onchange(text) }),
          text)));
  };
  draw();
  // on paper the map has half of the width
  printSteps.push(() => {
    draw(true, WIDTH.narrow);
    return () => draw();
  });
  return h("figure", { class: "map-block" },
    h("div", { class: "bar" },
      radio("Quantity", names, state.name, (one) => {
        state.name = one;
        draw();
      }),
      ...(components.length > 1
        ? [radio("Component", components, state.component, (one) => {
          state.component = one as MapLayer["component"];
          draw();
        })]
        : [])),
    host,
    ...(block.slices.length > 1 ? [h("div", { class: "bar map-slice" }, h("span", {}, "Slice"), slider, level)] : []),
    h("div", { class: "bar map-limit" }, h("span", { class: "map-good" }), good, limit, unit, share),
    value,
    h("figcaption", { class: "small" }, block.caption));
}

/** Decimals that tell values apart which lie a step from each other. */
const decimalsOf = (step: number): number => Math.max(0, -Math.floor(Math.log10(step) + 1e-9));

/** Decimals of a slice's level, by its distance from the others. */
function levelDecimals(block: ToolMapBlock, slice: MapSlice): number {
  const distances = block.slices
    .filter((one) => one.normal === slice.normal && one.level !== slice.level)
    .map((one) => Math.abs(one.level - slice.level));
  return distances.length ? decimalsOf(Math.min(...distances)) : 0;
}

/** Round levels between the smallest and the largest value. */
function levels(low: number, high: number): number[] {
  const places: number[] = [];
  if (low > 0 && high / low > WIDE_RANGE) {
    for (let k = Math.floor(Math.log10(low)); k <= Math.log10(high); k += 1) {
      places.push(...[1, 1.5, 2, 3, 5, 7].map((m) => m * 10 ** k));
    }
  } else {
    const rough = Math.max(high - low, 1e-12) / LEVELS;
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = power * ([1, 2, 5].find((m) => m * power >= rough) ?? 10);
    for (let k = Math.ceil(low / step); k * step <= high; k += 1) places.push(k * step);
  }
  return places.filter((x) => x > low && x < high).map((x) => Number(x.toPrecision(6)));
}

/** Values with the empty cells filled from the nearest full one, so that contours reach the border. */
function filled(grid: Grid): number[] {
  const full = grid.flatMap((row, y) => row.flatMap((z, x) => (z === null ? [] : [{ x, y, z }])));
  if (!full.length) return grid.flat().map(() => 0);
  return grid.flatMap((row, y) =>
    row.map((z, x) => z ?? full.reduce((best, one) =>
      (one.x - x) ** 2 + (one.y - y) ** 2 < (best.x - x) ** 2 + (best.y - y) ** 2 ? one : best).z));
}

function map(slice: MapSlice, layer: MapLayer, grid: Grid, wanted: number, block: ToolMapBlock, width: number) {
  const { u, v } = slice;
  const [du, dv] = [u, v].map((w) => (w.length > 1 ? w[1] - w[0] : 1));
  const scale = (width - LEFT - RIGHT) / (du * u.length);
  const height = TOP + dv * v.length * scale + BOTTOM;
  /** Drawing's coordinates of a place in cells, from the outer corner of the first. */
  const place = ([x, y]: number[]): [number, number] =>
    [LEFT + x * du * scale, TOP + (v.length - y) * dv * scale];
  const cellOf = (a: number, b: number): [number, number] => [(a - u[0]) / du + 0.5, (b - v[0]) / dv + 0.5];
  const path = (polygons: number[][][][]): string =>
    polygons.flat().map((ring) =>
      `M${ring.map((p) => place(p).map((c) => c.toFixed(1)).join(" ")).join("L")}Z`).join("");

  // the field within the reach of the machine, in bands with more ink where it is worse
  const values = filled(grid);
  const shape = contours().size([u.length, v.length]);
  const reach = shape.contour(grid.flat().map((z) => (z === null ? 0 : 1)), 0.5).coordinates;
  const known = layer.slices.flat(2).filter((z): z is number => z !== null);
  const steps = levels(Math.min(...known), Math.max(...known));
  const clip = `map-reach-${(count += 1)}`;
  const ink = (band: number): string => {
    const worse = layer.better === "small" ? band : steps.length - band;
    return `color-mix(in srgb, var(--drawing) ${FAINTEST + ((DARKEST - FAINTEST) * worse) / Math.max(steps.length, 1)}%, var(--card))`;
  };
  const field = svg("g", { "clip-path": `url(#${clip})` });
  const ground = svg("path", { d: path(reach) });
  ground.style.fill = ink(0);
  field.append(ground);
  const labels = svg("g", { class: "map-labels" });
  const taken: [number, number][] = [];
  steps.forEach((step, k) => {
    const { coordinates } = shape.contour(values, step);
    const band = svg("path", { d: path(coordinates), class: "map-band" });
    band.style.fill = ink(k + 1);
    field.append(band);
    const spot = labelPlace(coordinates.flat().flat().map(place), inReach, taken);
    if (!spot) return;
    taken.push(spot);
    labels.append(svg("text", { x: spot[0], y: spot[1] + 4 }, `${step}`));
  });
  // where the wanted accuracy holds
  const sign = layer.better === "small" ? -1 : 1;
  const good = shape.contour(values.map((z) => sign * z), sign * wanted).coordinates;
  field.append(svg("path", { d: path(good), class: "map-good-field" }));

  function valueAt([x, y]: [number, number]): number | null {
    const column = Math.floor((x - LEFT) / (du * scale));
    const row = Math.floor(v.length - (y - TOP) / (dv * scale));
    return grid[row]?.[column] ?? null;
  }
  function inReach(at: [number, number]): boolean {
    return valueAt(at) !== null;
  }

  const crosses = slice.poses.map((pose) => {
    const [x, y] = place(cellOf(pose.u, pose.v));
    return svg("path", { class: "map-pose", "data-key": pose.key, d: `M${x - 4} ${y - 4}l8 8m0 -8l-8 8` },
      svg("title", {}, pose.tip));
  });
  const picture = svg("svg", { viewBox: `0 0 ${width} ${height.toFixed(0)}`, role: "img", "aria-label": block.alt },
    svg("clipPath", { id: clip }, svg("path", { d: path(reach) })),
    field, svg("path", { class: "map-border", d: path(reach) }), labels, ...crosses,
    ...axis(u, du, (x) => place(cellOf(x, v[0]))[0], (x, text) =>
      svg("text", { x, y: height - BOTTOM + 18, "text-anchor": "middle" }, text)),
    ...axis(v, dv, (y) => place(cellOf(u[0], y))[1], (y, text) =>
      svg("text", { x: LEFT - 8, y: y + 4, "text-anchor": "end" }, text)),
    svg("text", { x: (LEFT + width) / 2, y: height - 8, "text-anchor": "middle", class: "map-title" }, `${slice.across}, mm`),
    svg("text", {
      x: 14, y: (height - BOTTOM) / 2, "text-anchor": "middle", class: "map-title",
      transform: `rotate(-90 14 ${(height - BOTTOM) / 2})`,
    }, `${slice.up}, mm`));
  const at = (event: PointerEvent): string => {
    const box = picture.getBoundingClientRect();
    const p: [number, number] = [
      ((event.clientX - box.left) / box.width) * width, ((event.clientY - box.top) / box.height) * height,
    ];
    const value = valueAt(p);
    if (value === null) return "";
    const x = u[0] + ((p[0] - LEFT) / (du * scale) - 0.5) * du;
    const y = v[0] + (v.length - (p[1] - TOP) / (dv * scale) - 0.5) * dv;
    const level = number(slice.level, levelDecimals(block, slice));
    return `${slice.across} ${number(x, decimalsOf(du))}, ${slice.up} ${number(y, decimalsOf(dv))},` +
      ` ${slice.normal} ${level} mm:` +
      ` ${Number(value.toPrecision(3))} ${layer.unit || "times"}`;
  };
  return { picture, at };
}

/** Point of a contour line within reach and farthest from the labels that are there. */
function labelPlace(
  points: [number, number][], inReach: (at: [number, number]) => boolean, taken: [number, number][],
): [number, number] | null {
  const inside = points.filter(([x, y]) =>
    [[0, 0], [14, 0], [-14, 0], [0, 8], [0, -8]].every(([a, b]) => inReach([x + a, y + b])));
  const room = (p: [number, number]): number => Math.min(1e9, ...taken.map((q) => Math.hypot(p[0] - q[0], p[1] - q[1])));
  const best = inside.reduce<[number, number] | null>((a, b) => (a && room(a) >= room(b) ? a : b), null);
  return best && room(best) > LABEL_SPACE ? best : null;
}

/** Ticks at round values within the cells. */
function axis(
  cells: number[], cell: number, position: (value: number) => number, text: (at: number, label: string) => SVGElement,
): SVGElement[] {
  const [low, high] = [cells[0] - cell / 2, cells[cells.length - 1] + cell / 2];
  const rough = (high - low) / 6;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 5].find((m) => m * power >= rough) ?? 10);
  const out: SVGElement[] = [];
  for (let k = Math.ceil(low / step); k * step <= high; k += 1) out.push(text(position(k * step), number(k * step, decimalsOf(step))));
  return out;
}
