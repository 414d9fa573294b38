/**
 * Plots in the plane with Observable Plot.
 *
 * Categories are drawn on a scale of numbers, the k-th at k + 1/2, so that all marks are placed in
 * the same manner. Colours are names of CSS variables: a change of the theme, or printing, needs
 * no new drawing.
 */

import * as Plot from "@observablehq/plot";
import type {
  BarsMark, BoxesMark, CellsMark, ColourScale, DotsMark, LineMark, Panels, Plot as PlotBlock, PlotAxis as Axis, Point,
} from "../document";
import { h, number, svg } from "../dom";
import type { Context } from "./index";
import "./plot.css";

type Mark = PlotBlock["marks"][number];
type Along = "x" | "y";
/** Place of a tooltip. */
interface Tip {
  x: number;
  y: number;
  text: string;
}
interface Size {
  width: number;
  height: number;
  marginLeft: number;
  marginRight: number;
  marginTop: number;
  marginBottom: number;
}

/** Width of a letter of a label, px, and height of a row of categories. */
const LETTER = 6.8, ROW = 22;
/** Share of a plot's width that names of rows may take. */
const MOST_NAMES = 0.4;
/** Widths of a plot on paper, px: alone, of two side by side, and of one with equal scales. */
const PAPER_WIDTH = 560, PAPER_PANEL_WIDTH = 400, PAPER_EQUAL_WIDTH = 460;
const PANEL_HEIGHT = 220, WIDE_HEIGHT = 320, HIGHEST = 620, WIDE = 560;
/** Part of a category's place that bars leave free, at each side. */
const GAP = 0.12;
/** Letters of a name below a bar. */
const LONGEST_NAME = 12;
const COLOUR_STEPS = 20;

export function panels(block: Panels, context: Context): HTMLElement {
  const several = block.plots.length > 1;
  return h("div", { class: "panels" },
    ...block.plots.map((one) => plot(one, context, several ? PAPER_PANEL_WIDTH : aloneOnPaper(one))));
}

const aloneOnPaper = (block: PlotBlock): number => (block.equal ? PAPER_EQUAL_WIDTH : PAPER_WIDTH);

export function plot(block: PlotBlock, { selection, printSteps }: Context, paperWidth = aloneOnPaper(block)): HTMLElement {
  const area = h("div", { class: "area" });
  let drawn = 0;
  const draw = (width: number) => {
    if (width === drawn) return;
    drawn = width;
    area.replaceChildren(picture(block, width));
    selection.apply(area);
  };
  draw(paperWidth); // a plot in a closed part of the page has no width yet
  new ResizeObserver(() => requestAnimationFrame(() => {
    if (area.clientWidth) draw(area.clientWidth);
  })).observe(area);
  // a drawing for the screen would be scaled down on paper, with its text
  printSteps.push(() => {
    const before = drawn;
    draw(paperWidth);
    return () => draw(before);
  });
  const caption = block.caption ? [h("p", { class: "small" }, block.caption)] : [];
  return h("figure", { class: "plot" },
    h("figcaption", {}, h("b", {}, block.title), ...caption), ...legend(block), area, ...values(block));
}

// ------------------------------------------------------------------ what stands beside the plot

function legend(block: PlotBlock): HTMLElement[] {
  const named = block.marks.filter((mark) => "name" in mark && mark.name !== "");
  const items = named.length > 1 ? named.map((mark) => h("li", {}, sign(mark), "name" in mark ? mark.name : "")) : [];
  const scale = block.colours ? [colourLegend(block.colours)] : [];
  return items.length ? [h("ul", { class: "legend" }, ...items), ...scale] : scale;
}

/** Small picture of a mark, for the legend. */
function sign(mark: Mark): SVGElement {
  const picture = svg("svg", { width: "20", height: "12", "aria-hidden": "true" });
  if (mark.mark === "line" || mark.mark === "rule") {
    const dashes = dashed(mark) ? "4,3" : "none";
    picture.append(svg("path", {
      d: "M0,6H20", stroke: colour(mark.colour), "stroke-width": "2", "stroke-dasharray": dashes, fill: "none",
    }));
  } else if (mark.mark === "dots") {
    picture.append(mark.symbol === "cross"
      ? svg("path", { d: "M6,2L14,10M14,2L6,10", stroke: colour(mark.colour), "stroke-width": "2" })
      : svg("circle", { cx: "10", cy: "6", r: "4", fill: colour(mark.colour) }));
  } else {
    const fill = mark.mark === "bars" ? colour(mark.colour) : "var(--band)";
    picture.append(svg("rect", { x: "2", y: "1", width: "16", height: "10", fill }));
  }
  return picture;
}

function colourLegend(scale: ColourScale): HTMLElement {
  const [low, high] = scale.limits;
  const swatches = Array.from({ length: COLOUR_STEPS }, (_, k) => {
    const swatch = h("i");
    swatch.style.background = shade(scale, low + ((k + 0.5) / COLOUR_STEPS) * (high - low));
    return swatch;
  });
  const ticks = scale.ticks.map((tick) => {
    const label = h("span", {}, tick.label);
    label.style.left = `${(100 * (tick.at - low)) / (high - low)}%`;
    return label;
  });
  return h("div", { class: "colours" }, h("span", {}, scale.label),
    h("div", {}, h("div", { class: "swatches" }, ...swatches), h("div", { class: "ticks" }, ...ticks)));
}

/** The tooltips as a list, for who cannot point at the plot. */
function values(block: PlotBlock): HTMLElement[] {
  const texts = block.marks.flatMap((mark) =>
    mark.mark === "boxes" ? mark.boxes.map((box) => box.tip)
      : mark.mark === "dots" || mark.mark === "bars" ? mark.points.map((point) => point.tip) : []);
  const items = texts.filter((text) => text !== "");
  if (!items.length) return [];
  return [h("details", { class: "values" }, h("summary", {}, "Values"),
    h("ul", {}, ...items.map((text) => h("li", {}, text))))];
}

// ------------------------------------------------------------------ the plot

function picture(block: PlotBlock, width: number): SVGElement {
  const size = sizeOf(block, width);
  const bars = block.marks.filter((mark) => mark.mark === "bars");
  const tips: Tip[] = [];
  const marks = block.marks.flatMap((mark) => drawn(block, mark, bars, tips));
  const across = block.y.scale === "categories" ? Plot.pointerY
    : bars.length || block.marks.some((mark) => mark.mark === "line") ? Plot.pointerX : Plot.pointer;
  const svg = Plot.plot({
    ...size,
    ariaLabel: block.alt,
    x: scale(block.x, "x"),
    y: scale(block.y, "y"),
    marks: [
      ...axis(block.x, "x", size), ...axis(block.y, "y", size), ...marks,
      Plot.tip(tips, across({ x: "x", y: "y", title: "text", lineWidth: 24, fontSize: 12, maxRadius: 30 })),
    ],
  }) as SVGElement;
  svg.setAttribute("role", "img");
  // the rules of this style element are in plot.css: the page's policy allows no other style
  svg.querySelector("style")?.remove();
  // the image has one description; its groups have no role that could have another
  for (const group of svg.querySelectorAll("g[aria-label]")) group.removeAttribute("aria-label");
  return svg;
}

function sizeOf(block: PlotBlock, width: number): Size {
  const { x, y } = block;
  const longest = Math.max(0, ...labels(y).map((text) => text.length));
  const marginLeft = Math.ceil(Math.min(12 + longest * LETTER, MOST_NAMES * width)) + (y.label && y.scale === "categories" ? 0 : 4);
  const margins = { marginLeft, marginRight: 14, marginTop: y.label ? 22 : 8, marginBottom: x.label ? 40 : 24 };
  const vertical = margins.marginTop + margins.marginBottom;
  const room = width - marginLeft - margins.marginRight;
  if (y.scale === "categories") return { width, height: ROW * y.categories.length + vertical, ...margins };
  if (block.equal) {
    const ratio = span(y) / span(x);
    const inner = Math.min(room, (HIGHEST - vertical) / ratio);
    return { width: width - room + inner, height: ratio * inner + vertical, ...margins };
  }
  return { width, height: width > WIDE ? WIDE_HEIGHT : PANEL_HEIGHT, ...margins };
}

const labels = (axis: Axis): string[] =>
  axis.scale === "categories" ? axis.categories : axis.ticks.map((tick) => tick.label);

const span = (axis: Axis): number => (axis.limits ? Math.abs(axis.limits[1] - axis.limits[0]) : axis.categories.length);

/** Scale of numbers; the first category of y is at the top. */
function scale(axis: Axis, along: Along): Plot.ScaleOptions {
  const ends = [0, axis.categories.length];
  const domain = axis.limits ?? (along === "x" ? ends : ends.reverse());
  return { type: axis.scale === "log" ? "log" : "linear", domain, clamp: true, axis: null };
}

/** Grid, labels and title of an axis. */
function axis(axis: Axis, along: Along, size: Size): Plot.Markish[] {
  const shorten = along === "x" ? shortened : (label: string) => label;
  const ticks = axis.scale === "categories"
    ? axis.categories.map((label, k) => ({ at: k + 0.5, label: shorten(label) })) : axis.ticks;
  const text = new Map(ticks.map((tick) => [tick.at, tick.label]));
  const options = {
    // without a limit on their number, a logarithmic scale would leave out labels of its choice
    ticks: Infinity, tickFormat: (at: number) => text.get(at) ?? "", tickSize: axis.scale === "categories" ? 0 : 4,
    label: axis.label || null, labelArrow: "none", fontSize: 12, color: "var(--muted)",
  } as const;
  const at = ticks.map((tick) => tick.at);
  const grid = { stroke: "var(--rule)", strokeOpacity: 1 };
  if (along === "x") {
    const shown = thinned(at, Math.max(...ticks.map((tick) => tick.label.length)), size);
    const lines = axis.scale === "categories" ? [] : [Plot.gridX(at, grid)];
    return [...lines, Plot.axisX(shown, { ...options, labelAnchor: "center", labelOffset: 36 })];
  }
  if (axis.scale === "categories") {
    const room = (size.marginLeft - 8) / 12;
    return [Plot.axisY(at, { ...options, textOverflow: "ellipsis-end", lineWidth: room })];
  }
  return [Plot.gridY(at, grid), Plot.axisY(at, { ...options, labelAnchor: "top", labelOffset: size.marginLeft - 4 })];
}

/** Name below a bar, which has little room; its tooltip has all of it. */
const shortened = (label: string): string =>
  label.length > LONGEST_NAME ? `${label.slice(0, LONGEST_NAME / 2 - 1)}…${label.slice(-LONGEST_NAME / 2)}` : label;

/** As many of the labels, at equal distances, as stand beside each other without touching. */
function thinned(at: number[], letters: number, size: Size): number[] {
  const room = size.width - size.marginLeft - size.marginRight;
  const most = Math.max(1, Math.floor(room / ((letters + 1.5) * LETTER)));
  const every = Math.ceil(at.length / most);
  return at.filter((_, k) => k % every === 0);
}

// ------------------------------------------------------------------ marks

function drawn(block: PlotBlock, mark: Mark, bars: BarsMark[], tips: Tip[]): Plot.Markish[] {
  switch (mark.mark) {
    case "line": return line(block, mark, tips);
    case "dots": return dots(block, mark, tips);
    case "bars": return barMarks(block, mark, bars, tips);
    case "boxes": return boxes(block, mark, tips);
    case "cells": return cells(block, mark, tips);
    case "band": {
      const band = { fill: "var(--band)" };
      return mark.axis === "x"
        ? [Plot.rectX([mark], { ...band, x1: "low", x2: "high" })]
        : [Plot.rectY([mark], { ...band, y1: "low", y2: "high" })];
    }
    case "rule": {
      const rule = { stroke: colour(mark.colour), strokeDasharray: "4,3" };
      return mark.axis === "x" ? [Plot.ruleX([mark.at], rule)] : [Plot.ruleY([mark.at], rule)];
    }
  }
}

function line(block: PlotBlock, mark: LineMark, tips: Tip[]): Plot.Markish[] {
  const points = mark.points.map(([x, y]) => ({ x: place(block.x, x), y: y ?? NaN }));
  const covered = block.marks.some((one) => one.mark === "dots" || one.mark === "bars");
  if (!covered) {
    for (const [k, [x, y]] of mark.points.entries()) {
      const at = points[k];
      if (at && y !== null) tips.push({ ...at, text: `${mark.name ? `${mark.name}\n` : ""}${valueText(block.x, x)}\n${valueText(block.y, y)}` });
    }
  }
  return [Plot.line(points, {
    x: "x", y: "y", stroke: colour(mark.colour), strokeWidth: 1.75, clip: true,
    ...(mark.dashed ? { strokeDasharray: "5,4" } : {}), ...keyed(() => mark.key),
  })];
}

/** Value of an axis in words, for a tooltip. */
function valueText(axis: Axis, value: number | string): string {
  if (typeof value === "string") return axis.label ? `${axis.label}: ${value}` : value;
  const decimals = Math.max(0, 2 - Math.floor(Math.log10(Math.abs(value) || 1)));
  return `${axis.label}: ${number(value, Math.min(decimals, 8))}`;
}

function dots(block: PlotBlock, mark: DotsMark, tips: Tip[]): Plot.Markish[] {
  const points = placed(block, mark.points, tips);
  const fill = (point: Placed) => fillOf(block, mark.colour, point.of);
  const marks: Plot.Markish[] = [intervals(block, points, (point) => fill(point))];
  const options = { x: "x", y: "y", ...keyed((k) => mark.points[k]?.key) };
  marks.push(mark.symbol === "cross"
    ? Plot.dot(points, { ...options, symbol: "times", r: mark.radius, stroke: { value: fill, scale: null }, strokeWidth: 2 })
    : Plot.dot(points, {
        ...options, r: mark.radius, fill: { value: fill, scale: null },
        ...(block.colours ? { stroke: "var(--quiet)", strokeWidth: 0.75 } : {}),
      }));
  return marks;
}

function barMarks(block: PlotBlock, mark: BarsMark, all: BarsMark[], tips: Tip[]): Plot.Markish[] {
  const along = block.y.scale === "categories" ? "y" : "x";
  const values = along === "x" ? block.y : block.x;
  const base = values.scale === "log" && values.limits ? values.limits[0] : 0;
  const width = mark.width || (1 - 2 * GAP) / all.length;
  const offset = mark.width ? 0 : (all.indexOf(mark) - (all.length - 1) / 2) * width;
  const points = placed(block, mark.points, tips, along === "x" ? [offset, 0] : [0, offset]);
  const half = width * (mark.width ? 0.46 : 0.5);
  const sides = along === "x"
    ? { x1: (p: Placed) => p.x - half, x2: (p: Placed) => p.x + half, y1: () => base, y2: (p: Placed) => p.y }
    : { y1: (p: Placed) => p.y - half, y2: (p: Placed) => p.y + half, x1: () => base, x2: (p: Placed) => p.x };
  return [
    Plot.rect(points, {
      ...sides, fill: { value: (p: Placed) => fillOf(block, mark.colour, p.of), scale: null },
      ...keyed((k) => mark.points[k]?.key),
    }),
    intervals(block, points, () => "var(--ink)"),
    along === "x" ? Plot.ruleY([base], { stroke: "var(--quiet)" }) : Plot.ruleX([base], { stroke: "var(--quiet)" }),
  ];
}

function boxes(block: PlotBlock, mark: BoxesMark, tips: Tip[]): Plot.Markish[] {
  const rows = mark.boxes.map((box) => ({ box, y: place(block.y, box.at), q: box.quantiles }));
  type Row = (typeof rows)[number];
  for (const { box, y, q } of rows) tips.push({ x: q[2], y, text: box.tip });
  const ink = (row: Row) => colour(row.box.colour);
  const key = keyed((k) => mark.boxes[k]?.key);
  return [
    Plot.ruleY(rows, { y: "y", x1: (row: Row) => row.q[0], x2: (row: Row) => row.q[4], stroke: { value: ink, scale: null }, strokeWidth: 1.5 }),
    Plot.rect(rows, {
      x1: (row: Row) => row.q[1], x2: (row: Row) => row.q[3], y1: (row: Row) => row.y - 0.28, y2: (row: Row) => row.y + 0.28,
      fill: { value: ink, scale: null }, ...key,
    }),
    Plot.ruleX(rows, {
      x: (row: Row) => row.q[2], y1: (row: Row) => row.y - 0.36, y2: (row: Row) => row.y + 0.36, stroke: "var(--ink)", strokeWidth: 2,
    }),
  ];
}

/** Cells: one path for each of a few colours, however many cells there are. */
function cells(block: PlotBlock, mark: CellsMark, tips: Tip[]): Plot.Markish[] {
  const colours = block.colours;
  if (!colours) return [];
  const columns = mark.columns.length, rows = mark.rows.length;
  const at = (ends: [number, number], share: number) => ends[0] + share * (ends[1] - ends[0]);
  const grouped = new Map<number, [number, number][]>();
  const [low, high] = colours.limits;
  for (const [r, row] of mark.values.entries()) {
    for (const [c, value] of row.entries()) {
      if (value === null) continue;
      const step = Math.round(((value - low) / (high - low)) * 2 * COLOUR_STEPS);
      const places = grouped.get(step) ?? [];
      places.push([c, r]);
      grouped.set(step, places);
      tips.push({
        x: at(mark.x, (c + 0.5) / columns), y: at(mark.y, (r + 0.5) / rows),
        text: `${mark.rows[r]}\n${mark.columns[c]}\n${valueText({ ...block.x, label: colours.label }, value)}`,
      });
    }
  }
  return [(_index, scales) => {
    const g = svg("g", { "aria-hidden": "true" });
    const px = (share: number) => (scales.x as (value: number) => number)(at(mark.x, share)).toFixed(1);
    const py = (share: number) => (scales.y as (value: number) => number)(at(mark.y, share)).toFixed(1);
    for (const [step, places] of grouped) {
      const d = places.map(([c, r]) =>
        `M${px(c / columns)},${py(r / rows)}H${px((c + 1) / columns)}V${py((r + 1) / rows)}H${px(c / columns)}Z`).join("");
      g.append(svg("path", { d, fill: shade(colours, low + (step / (2 * COLOUR_STEPS)) * (high - low)) }));
    }
    return g as SVGElement;
  }];
}

interface Placed {
  x: number;
  y: number;
  low: number | null;
  high: number | null;
  of: Point;
}

/** Points with numbers for their positions; those with a text get a tooltip. */
function placed(block: PlotBlock, points: Point[], tips: Tip[], offset: [number, number] = [0, 0]): Placed[] {
  return points.map((point) => {
    const x = place(block.x, point.x) + offset[0], y = place(block.y, point.y) + offset[1];
    if (point.tip) tips.push({ x, y, text: point.tip });
    return { x, y, low: point.low, high: point.high, of: point };
  });
}

/** Lines from the low to the high end of the points that have them. */
function intervals(block: PlotBlock, points: Placed[], stroke: (point: Placed) => string): Plot.Markish {
  const those = points.filter((point) => point.low !== null && point.high !== null);
  const options = { stroke: { value: stroke, scale: null }, strokeWidth: 1.5 };
  return block.y.scale === "categories"
    ? Plot.ruleY(those, { ...options, y: "y", x1: "low", x2: "high" })
    : Plot.ruleX(those, { ...options, x: "x", y1: "low", y2: "high" });
}

/** Mark the elements of a mark with their keys, for the selection. */
function keyed(key: (index: number) => string | undefined): { render: Plot.RenderFunction } {
  return {
    render(index, scales, values, dimensions, context, next) {
      const g = next?.(index, scales, values, dimensions, context) ?? null;
      for (const element of g?.children ?? []) {
        const datum = (element as Element & { __data__?: number | number[] }).__data__;
        const own = key(Array.isArray(datum) ? (datum[0] ?? 0) : (datum ?? 0));
        if (own) (element as SVGElement).dataset.key = own;
      }
      return g;
    },
  };
}

const place = (axis: Axis, value: number | string): number =>
  typeof value === "string" ? axis.categories.indexOf(value) + 0.5 : value;

// ------------------------------------------------------------------ colours

const fillOf = (block: PlotBlock, own: string, point: Point): string =>
  block.colours && point.value !== null ? shade(block.colours, point.value) : colour(point.colour ?? own);

const colour = (name: string): string =>
  `var(--${name === "nominal" ? "drawing" : name.replace("leg-", "leg")})`;

const dashed = (mark: Mark): boolean => mark.mark === "rule" || (mark.mark === "line" && mark.dashed);

/** Colour of a value: the further from the middle, or from the lower limit, the more of it. */
function shade(scale: ColourScale, value: number): string {
  const [low, high] = scale.limits;
  const share = Math.min(Math.max((value - low) / (high - low || 1), 0), 1);
  const [part, name] = scale.diverging
    ? [Math.abs(2 * share - 1), share < 0.5 ? "drawing" : "calibrated"] : [share, "drawing"];
  return `color-mix(in oklab, var(--${name}) ${(100 * part).toFixed(0)}%, var(--card))`;
}
