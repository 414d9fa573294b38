// Generated from src/pkmcal/web/schema.json by `npm run types`; do not edit.

export type ViewerDocument = MachineDocument | ReportDocument;

/**
 * Page of a machine with sliders for its readings.
 *
 * subtitle : below the heading.
 * notes : sentences below it.
 * machine : the machine of the stage.
 * sweeps : one for each reading; null if the page asks the program for poses.
 * redundant : whether other readings follow if one changes.
 */
export interface MachineDocument {
  version: 1;
  program: string;
  title: string;
  kind: "machine";
  subtitle: string;
  notes: string[];
  machine: Machine;
  sweeps: Sweep[] | null;
  redundant: boolean;
}
/**
 * Machine of a stage.
 *
 * name, motion : of the mechanism file.
 * base_outline, platform_outline : closed polygons through joints; the latter in the platform
 *     frame.
 * workspace : positions of the platform's origin at readings within their ranges.
 * home : the first configuration.
 */
export interface Machine {
  name: string;
  motion: string;
  legs: Leg[];
  readings: Reading[];
  axes: Axis[];
  base_outline: [number, number, number][];
  platform_outline: [number, number, number][];
  cameras: CameraShape[];
  workspace: [number, number, number][];
  home: Configuration;
}
/**
 * What of a leg does not depend on the configuration.
 *
 * number : from 1.
 * reading : index of its reading, null without one.
 * body : index of the platform's bar on which the leg ends, null for a rigid platform.
 * tubes : empty if the file has none; then the rod is drawn with a thin line.
 * path : of A over the range of the reading; empty if the reading does not move A.
 * rows : its parameters.
 */
export interface Leg {
  number: number;
  reading: number | null;
  body: number | null;
  tubes: Tube[];
  path: [number, number, number][];
  rows: Row[];
}
/**
 * Visible cylinder of a leg; ``start`` and ``stop`` from A towards B, m.
 */
export interface Tube {
  radius: number;
  start: number;
  stop: number;
}
/**
 * Row of a table of properties.
 */
export interface Row {
  label: string;
  value: string;
}
/**
 * Joint reading: its range and the sense of its sign.
 *
 * unit : m or rad.
 * low, high : range of the slider.
 * stated : whether this is the range of the mechanism file; otherwise it is an assumption.
 * legs : indices of the legs that it moves.
 * direction, zero : sentences on what a larger reading does, and where the reading is zero.
 */
export interface Reading {
  name: string;
  unit: "m" | "rad";
  low: number;
  high: number;
  stated: boolean;
  legs: number[];
  direction: string;
  zero: string;
}
/**
 * Axis of a joint: a point and a unit direction, in the frame of the body that holds it.
 */
export interface Axis {
  leg: number;
  side: "base" | "platform";
  /**
   * @minItems 3
   * @maxItems 3
   */
  point: [number, number, number];
  /**
   * @minItems 3
   * @maxItems 3
   */
  direction: [number, number, number];
  label: string;
}
/**
 * Camera at its station: the border of the image at some depth, and rays to its corners.
 */
export interface CameraShape {
  name: string;
  /**
   * @minItems 3
   * @maxItems 3
   */
  position: [number, number, number];
  lines: [number, number, number][][];
}
/**
 * Machine at one set of readings.
 *
 * readings : in m or rad.
 * T_base_platform : rows of the matrix.
 * rotation : rotation vector of the platform, rad.
 * legs : in their order.
 * beyond : indices of the readings outside their stated ranges.
 */
export interface Configuration {
  readings: number[];
  /**
   * @minItems 4
   * @maxItems 4
   */
  T_base_platform: [
    [number, number, number, number],
    [number, number, number, number],
    [number, number, number, number],
    [number, number, number, number]
  ];
  /**
   * @minItems 3
   * @maxItems 3
   */
  rotation: [number, number, number];
  legs: LegConfiguration[];
  beyond: number[];
}
/**
 * Lines of a leg in one configuration.
 *
 * base : from where a motor holds the arm, if there is one, to A.
 * platform : from the hinge of a bar, if there is one, to B.
 * positive : way of the moving point as the reading grows, for an arrow beside it.
 * zero : the arm, or A, or the point of the leg from which its length is counted, at reading zero.
 */
export interface LegConfiguration {
  base: [number, number, number][];
  platform: [number, number, number][];
  positive: [number, number, number][];
  zero: [number, number, number][];
}
/**
 * Configurations with one reading changed from home; null where no pose was found.
 */
export interface Sweep {
  values: number[];
  configurations: (Configuration | null)[];
}
/**
 * Report of a command.
 *
 * kicker : line above the title. subject : what was examined. origin : date, program, digest.
 * notes : the user's own text.
 * warnings, advice, remarks : sentences below the verdict.
 */
export interface ReportDocument {
  version: 1;
  program: string;
  title: string;
  kind: "report";
  kicker: string;
  subject: string;
  origin: string[];
  notes: string;
  verdict: Verdict;
  warnings: string[];
  advice: string[];
  remarks: string[];
  cards: Card[];
  sections: Section[];
}
/**
 * Judgement at the top of a report.
 *
 * tone : good, partial (usable, with exceptions) or bad.
 * stamp : one to three words.
 */
export interface Verdict {
  tone: "good" | "partial" | "bad";
  stamp: string;
  headline: string;
  reasons: string[];
}
/**
 * Card with the numbers that answer one question.
 *
 * values : numbers with their units, as text.
 */
export interface Card {
  question: string;
  values: [string, string][];
  note: string;
}
/**
 * Section of a report; menu : its name in the table of contents.
 */
export interface Section {
  name: string;
  title: string;
  menu: string;
  blocks: (Paragraph | Listing | Checks | Downloads | Images)[];
}
/**
 * Paragraph; small : as small print.
 */
export interface Paragraph {
  kind: "paragraph";
  text: string;
  small: boolean;
}
/**
 * List with a heading, which may be empty; folded : collapsed until it is opened.
 */
export interface Listing {
  kind: "listing";
  title: string;
  items: string[];
  folded: boolean;
}
/**
 * Comparisons with expected values.
 */
export interface Checks {
  kind: "checks";
  checks: CheckLine[];
}
/**
 * Comparison with an expected value, in one line.
 */
export interface CheckLine {
  text: string;
  passed: boolean;
}
/**
 * Files that the page holds.
 */
export interface Downloads {
  kind: "downloads";
  files: Download[];
}
/**
 * File that the page holds; content : its text.
 */
export interface Download {
  name: string;
  media_type: string;
  content: string;
}
/**
 * Grid of images; each opens in the inspector.
 *
 * first : number of images until the reader asks for all.
 * legs : number of legs, for the colours' key; 0 for none.
 * size : width of an image in the grid.
 */
export interface Images {
  kind: "images";
  images: Image[];
  first: number;
  legs: number;
  size: "thumbnail" | "figure";
}
/**
 * Image with its overlays.
 *
 * title, caption : name and contents.
 * group : for the filter, such as the station; empty for none.
 * key : of the image, so that a selection elsewhere finds it.
 * width, height : of the camera's image, px.
 * quarter_turns : clockwise, that turn it upright, as EXIF says.
 * jpeg : base64, of at most these pixels; empty if the file cannot be read.
 * overlays : of which a viewer shows one at a time.
 * strip_jpeg : the strips one below the other, base64; empty without any.
 */
export interface Image {
  title: string;
  caption: string;
  group: string;
  key: string;
  width: number;
  height: number;
  quarter_turns: number;
  jpeg: string;
  overlays: Overlay[];
  strip_jpeg: string;
  strips: Strip[];
}
/**
 * Layers over an image; title : which of several overlays, empty for the only one.
 */
export interface Overlay {
  title: string;
  layers: Layer[];
}
/**
 * Shapes that are switched on and off together.
 *
 * name : kind of the shapes, for title, shortcut and style.
 * enlargement : of the arrows.
 */
export interface Layer {
  name: "edges" | "rejected" | "joints" | "nominal" | "corners" | "residuals";
  shapes: (Polyline | Ring | Cross | Arrow)[];
  enlargement: number;
}
/**
 * Curve in an image.
 *
 * key : what it belongs to; a leg's key gives the colour.
 * tip : tooltip.
 * dashed : measured, but not in use.
 * strip : index of its strip in the image's ``strips``, null without one.
 */
export interface Polyline {
  shape: "polyline";
  points: [number, number][];
  key: string;
  tip: string;
  dashed: boolean;
  strip: number | null;
}
/**
 * Circle of a fixed size around a pixel; label : text beside it, such as a leg's number.
 */
export interface Ring {
  shape: "ring";
  /**
   * @minItems 2
   * @maxItems 2
   */
  at: [number, number];
  key: string;
  tip: string;
  dashed: boolean;
  label: string;
}
/**
 * Cross of a fixed size at a pixel.
 */
export interface Cross {
  shape: "cross";
  /**
   * @minItems 2
   * @maxItems 2
   */
  at: [number, number];
  key: string;
  tip: string;
}
/**
 * Displacement (px) from a pixel, drawn as many times as long as its layer's enlargement.
 *
 * key : what a click leads to.
 * dashed : not significant, or not in use.
 * label : text beside the tip, such as the length of a scale.
 */
export interface Arrow {
  shape: "arrow";
  /**
   * @minItems 2
   * @maxItems 2
   */
  at: [number, number];
  /**
   * @minItems 2
   * @maxItems 2
   */
  displacement: [number, number];
  key: string;
  tip: string;
  dashed: boolean;
  label: string;
}
/**
 * Image along an edge, sampled in native pixels across the predicted edge and along it.
 *
 * title : name of the edge, its residual and standard deviation.
 * row : first row of the strip in the image's ``strip_jpeg``.
 * length, across : columns along the edge, from A to B, and rows across it, outward first; the
 *     prediction is in the middle row.
 * offset : offset of the fitted line from the prediction, px outward, at evenly spaced positions
 *     from the middle of the first column to that of the last.
 * sigma : its standard deviation there, px.
 */
export interface Strip {
  title: string;
  row: number;
  length: number;
  across: number;
  offset: number[];
  sigma: number[];
}
