// Generated from src/pkmcal/web/schema.json by `npm run types`; do not edit.

/**
 * Severity of a finding: reason against the result, warning, or note (advice).
 */
export type Level = "wrong" | "doubtful" | "note";
export type ViewerDocument = MachineDocument | ReportDocument | SessionDocument | FolderDocument;

export interface EveryType {
  Arrow: Arrow;
  BandMark: BandMark;
  BarsMark: BarsMark;
  Box: Box;
  BoxesMark: BoxesMark;
  CameraShape: CameraShape;
  Card: Card;
  CellsMark: CellsMark;
  ColourScale: ColourScale;
  Column: Column;
  Configuration: Configuration;
  Cross: Cross;
  DataTable: DataTable;
  DotsMark: DotsMark;
  Download: Download;
  Downloads: Downloads;
  Ellipsoid: Ellipsoid;
  Fact: Fact;
  Facts: Facts;
  Filter: Filter;
  FolderDocument: FolderDocument;
  FolderEntry: FolderEntry;
  Hint: Hint;
  Image: Image;
  Images: Images;
  JointAxis: JointAxis;
  Layer: Layer;
  Leg: Leg;
  LegChange: LegChange;
  LegConfiguration: LegConfiguration;
  Level: Level;
  LineMark: LineMark;
  Listing: Listing;
  LogBar: LogBar;
  Machine: Machine;
  MachineDocument: MachineDocument;
  Magnitude: Magnitude;
  MapLayer: MapLayer;
  MapPose: MapPose;
  MapSlice: MapSlice;
  Overlay: Overlay;
  Panels: Panels;
  Paragraph: Paragraph;
  Plot: Plot;
  PlotAxis: PlotAxis;
  Point: Point;
  Polyline: Polyline;
  Property: Property;
  Reading: Reading;
  ReportDocument: ReportDocument;
  Ring: Ring;
  RuleMark: RuleMark;
  Section: Section;
  SessionDocument: SessionDocument;
  SessionStation: SessionStation;
  Space: Space;
  SpaceArrows: SpaceArrows;
  SpacePath: SpacePath;
  SpacePoints: SpacePoints;
  SpacePose: SpacePose;
  Strip: Strip;
  Sweep: Sweep;
  TableRow: TableRow;
  Tick: Tick;
  ToolMapBlock: ToolMapBlock;
  Tube: Tube;
  Verdict: Verdict;
  EdgesAnswer: EdgesAnswer;
  Gesture: Gesture;
  JointPixel: JointPixel;
  LegCount: LegCount;
  LocalizationAnswer: LocalizationAnswer;
  OverlayAnswer: OverlayAnswer;
  Pin: Pin;
  SavedAnswer: SavedAnswer;
  ViewRequest: ViewRequest;
  ViewerDocument: ViewerDocument;
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
  key?: string;
  tip?: string;
  dashed?: boolean;
  label?: string;
}
/**
 * Shaded range of an axis, over the whole of the other one.
 */
export interface BandMark {
  mark: "band";
  name: string;
  axis: "x" | "y";
  low: number;
  high: number;
}
/**
 * Bars from zero, with intervals as lines over them.
 *
 * width : of a bar on an axis of numbers; 0 on one of categories, whose bars fill their place.
 *     Bars of several marks stand side by side on an axis of categories.
 */
export interface BarsMark {
  mark: "bars";
  name: string;
  colour:
    | "nominal"
    | "calibrated"
    | "quiet"
    | "ink"
    | "good"
    | "warn"
    | "bad"
    | "leg-1"
    | "leg-2"
    | "leg-3"
    | "leg-4"
    | "leg-5"
    | "leg-6"
    | "leg-7"
    | "leg-8";
  points: Point[];
  width: number;
}
/**
 * Point of a mark.
 *
 * low, high : ends of an interval along the axis of the values, which is y unless y has
 *     categories: a standard deviation's bar, or the range that is expected.
 * tip : tooltip.
 * key : what the point belongs to; empty for nothing.
 * colour : null for the mark's.
 * value : for the plot's colour scale.
 */
export interface Point {
  x: number | string;
  y: number | string;
  low: number | null;
  high: number | null;
  tip: string;
  key: string;
  colour:
    | (
        | "nominal"
        | "calibrated"
        | "quiet"
        | "ink"
        | "good"
        | "warn"
        | "bad"
        | "leg-1"
        | "leg-2"
        | "leg-3"
        | "leg-4"
        | "leg-5"
        | "leg-6"
        | "leg-7"
        | "leg-8"
      )
    | null;
  value: number | null;
}
/**
 * Distribution in one row: quantiles at 5, 25, 50, 75 and 95 %, those in the middle as a bar.
 *
 * at : category of the y axis.
 */
export interface Box {
  at: string;
  /**
   * @minItems 5
   * @maxItems 5
   */
  quantiles: [number, number, number, number, number];
  tip: string;
  key: string;
  colour:
    | "nominal"
    | "calibrated"
    | "quiet"
    | "ink"
    | "good"
    | "warn"
    | "bad"
    | "leg-1"
    | "leg-2"
    | "leg-3"
    | "leg-4"
    | "leg-5"
    | "leg-6"
    | "leg-7"
    | "leg-8";
}
/**
 * Box plots, one in each row.
 */
export interface BoxesMark {
  mark: "boxes";
  boxes: Box[];
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
 * Card with the numbers that answer one question.
 *
 * values : numbers with their units, as text.
 * limit : of a usable result; empty without one. mark : of the number against it.
 */
export interface Card {
  question: string;
  values: [string, string][];
  note: string;
  limit: string;
  mark: "good" | Level | null;
}
/**
 * Rectangle of cells of equal size, coloured by the plot's colour scale.
 *
 * x, y : values of the axes at its left and right, and at its top and bottom.
 * values : of each row, from the top; null for an empty cell.
 * columns, rows : names for the tooltips.
 */
export interface CellsMark {
  mark: "cells";
  /**
   * @minItems 2
   * @maxItems 2
   */
  x: [number, number];
  /**
   * @minItems 2
   * @maxItems 2
   */
  y: [number, number];
  values: (number | null)[][];
  columns: string[];
  rows: string[];
}
/**
 * Colours of values, with its legend.
 *
 * diverging : two colours on either side of the middle of ``limits``; otherwise one, the larger
 *     the more ink.
 */
export interface ColourScale {
  label: string;
  /**
   * @minItems 2
   * @maxItems 2
   */
  limits: [number, number];
  ticks: Tick[];
  diverging: boolean;
}
/**
 * Label of an axis at a value.
 */
export interface Tick {
  at: number;
  label: string;
}
/**
 * Column of a table.
 *
 * form : text; number, to the right, ``a ± b`` with the second part small; leg, a chip with the
 *     leg's colour; share, a bar from 0 to 1 beside its text; shade, a number whose cell is the
 *     darker the larger it is among those of all such columns; chance, a probability in words,
 *     whose number is its tooltip.
 * hint : explanation of the heading.
 * by_size : sorted by the size of the values, whatever their sign, as changes are.
 */
export interface Column {
  name: string;
  form: "text" | "number" | "leg" | "share" | "shade" | "chance";
  hint: string;
  by_size: boolean;
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
 * base : from the motor of the arm, if there is one, to A.
 * platform : from the hinge of a bar, if there is one, to B.
 * positive : direction of the moving point for an increasing reading, for an arrow beside it.
 * zero : position of the arm, of A, or of the point from which the leg's length is counted, at
 *     reading zero.
 */
export interface LegConfiguration {
  base: [number, number, number][];
  platform: [number, number, number][];
  positive: [number, number, number][];
  zero: [number, number, number][];
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
  key?: string;
  tip?: string;
}
/**
 * Table; folded : collapsed until it is opened.
 */
export interface DataTable {
  kind: "table";
  title: string;
  columns: Column[];
  rows: TableRow[];
  note: string;
  folded: boolean;
  filters: Filter[];
}
/**
 * Row of a table.
 *
 * cells : text of each column.
 * values : number of each cell, by which the column is sorted and which a copy holds; null where
 *     the cell is a text.
 * name : for copies, before all columns, where the cells have only a short one.
 * tags : filters that the row passes.
 * quiet : in a muted colour.
 */
export interface TableRow {
  cells: string[];
  values: (number | null)[];
  key: string;
  name: string;
  hint: string;
  mark: "good" | Level | null;
  tags: string[];
  quiet: boolean;
}
/**
 * Button that filters rows by a tag.
 *
 * group : name of the filters of which a row has to pass one, such as legs; filters of several
 *     groups have to be passed all.
 * hides : rows with the tag are hidden until the button is pressed.
 */
export interface Filter {
  tag: string;
  label: string;
  group: string;
  hides: boolean;
}
/**
 * Dots, with intervals as lines through them.
 */
export interface DotsMark {
  mark: "dots";
  name: string;
  colour:
    | "nominal"
    | "calibrated"
    | "quiet"
    | "ink"
    | "good"
    | "warn"
    | "bad"
    | "leg-1"
    | "leg-2"
    | "leg-3"
    | "leg-4"
    | "leg-5"
    | "leg-6"
    | "leg-7"
    | "leg-8";
  points: Point[];
  symbol: "circle" | "cross";
  radius: number;
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
 * Files that the page holds.
 */
export interface Downloads {
  kind: "downloads";
  files: Download[];
}
/**
 * Uncertainty of a joint centre; drawn enlarged.
 *
 * leg : index from 0.
 * axes : semi-axes, m, in the frame of the side.
 */
export interface Ellipsoid {
  leg: number;
  side: "base" | "platform";
  /**
   * @minItems 3
   * @maxItems 3
   */
  axes: [[number, number, number], [number, number, number], [number, number, number]];
}
/**
 * Name of a quantity or setting, and its value as text.
 */
export interface Fact {
  name: string;
  value: string;
}
/**
 * Pairs of name and value with a heading.
 */
export interface Facts {
  kind: "facts";
  title: string;
  facts: Fact[];
}
/**
 * Page of a folder with sessions and results.
 *
 * note : on what is not listed.
 */
export interface FolderDocument {
  version: 1;
  program: string;
  title: string;
  kind: "folder";
  entries: FolderEntry[];
  note: string;
}
/**
 * Session or result in a folder.
 *
 * name : path in the folder. href : of its page, relative to the list's; empty if it cannot be
 *     opened.
 * title : of its page. date : of the result; empty where it has none.
 * mark, text : verdict, or why it cannot be opened.
 * before, after : tool errors by the nominal model and after the calibration; empty without them.
 */
export interface FolderEntry {
  name: string;
  href: string;
  title: string;
  date: string;
  mark: "good" | Level | null;
  text: string;
  before: string;
  after: string;
}
/**
 * How to use the page, in small print; not on paper.
 */
export interface Hint {
  kind: "hint";
  text: string;
}
/**
 * Image with its overlays.
 *
 * title, caption : name and contents.
 * group : for the filter, such as the station; empty for none.
 * key : of the image, so that a selection elsewhere finds it.
 * width, height : of the camera's image, px.
 * quarter_turns : clockwise, that turn it upright, as EXIF says.
 * webp : base64, of at most these pixels; empty if the file cannot be read.
 * url : of the image beside a page that is served, in place of ``webp``.
 * overlays : of which a viewer shows one at a time.
 * strip_webp : the strips one below the other, base64; empty without any.
 * strip_rows : rows of each strip.
 */
export interface Image {
  title: string;
  caption: string;
  group: string;
  key: string;
  width: number;
  height: number;
  quarter_turns: number;
  webp: string;
  url: string;
  overlays: Overlay[];
  strip_webp: string;
  strip_rows: number;
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
  name: "machine" | "edges" | "rejected" | "joints" | "nominal" | "corners" | "residuals";
  shapes: (Polyline | Ring | Cross | Arrow)[];
  enlargement: number;
}
/**
 * Curve in an image.
 *
 * key : what it belongs to; a leg's key gives the colour.
 * tip : tooltip.
 * dashed : measured, but not in use.
 * strip : index of its strip in the image's ``strips``, absent without one.
 */
export interface Polyline {
  shape: "polyline";
  points: [number, number][];
  key?: string;
  tip?: string;
  dashed?: boolean;
  strip?: number | null;
}
/**
 * Circle of a fixed size around a pixel.
 *
 * label : text beside it, such as a leg's number.
 * filled : the joint was placed here by hand.
 */
export interface Ring {
  shape: "ring";
  /**
   * @minItems 2
   * @maxItems 2
   */
  at: [number, number];
  key?: string;
  tip?: string;
  dashed?: boolean;
  label?: string;
  filled?: boolean;
}
/**
 * Image along an edge, sampled in native pixels across the predicted edge and along it.
 *
 * length : columns along the edge, from A to B. Rows are across it, outward first; the prediction
 *     is in the middle row.
 * offset : offset of the fitted line from the prediction, px outward, at evenly spaced positions
 *     from the middle of the first column to that of the last.
 * sigma : its standard deviation there, px.
 */
export interface Strip {
  length: number;
  offset: number[];
  sigma: number[];
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
 * Axis of a joint: a point and a unit direction, in the frame of the body that holds it.
 */
export interface JointAxis {
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
 * Properties of a leg that do not depend on the configuration.
 *
 * number : from 1.
 * reading : index of its reading, null without one.
 * body : index of the platform's bar on which the leg ends, null for a rigid platform.
 * tubes : empty if the file has none; the rod is then drawn as a thin line.
 * path : positions of A over the range of the reading; empty if the reading does not move A.
 * rows : its parameters.
 */
export interface Leg {
  number: number;
  reading: number | null;
  body: number | null;
  tubes: Tube[];
  path: [number, number, number][];
  rows: Property[];
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
export interface Property {
  label: string;
  value: string;
}
/**
 * Change of a leg's lines from one machine to the other, m; drawn enlarged.
 *
 * base : of each point of the leg's ``base``, base frame.
 * platform : of each point of its ``platform``, platform frame.
 */
export interface LegChange {
  base: [number, number, number][];
  platform: [number, number, number][];
}
/**
 * Polyline; a null breaks it. name : in the legend; empty for no entry.
 */
export interface LineMark {
  mark: "line";
  name: string;
  colour:
    | "nominal"
    | "calibrated"
    | "quiet"
    | "ink"
    | "good"
    | "warn"
    | "bad"
    | "leg-1"
    | "leg-2"
    | "leg-3"
    | "leg-4"
    | "leg-5"
    | "leg-6"
    | "leg-7"
    | "leg-8";
  points: [number | string, number | null][];
  dashed: boolean;
  key: string;
}
/**
 * List with a heading, which may be empty.
 *
 * items : texts; what follows a line break is the next step.
 * folded : collapsed until it is opened.
 */
export interface Listing {
  kind: "listing";
  title: string;
  items: string[];
  folded: boolean;
}
/**
 * Magnitudes of one quantity, such as the tool's error before and after a calibration.
 *
 * unit : of the values. note : small print.
 */
export interface LogBar {
  kind: "log_bar";
  title: string;
  unit: string;
  magnitudes: Magnitude[];
  note: string;
}
/**
 * Positive magnitude with its text; role decides the colour.
 */
export interface Magnitude {
  label: string;
  value: number;
  text: string;
  role: "prior" | "nominal" | "calibrated" | "test";
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
  axes: JointAxis[];
  base_outline: [number, number, number][];
  platform_outline: [number, number, number][];
  cameras: CameraShape[];
  workspace: [number, number, number][];
  home: Configuration;
}
/**
 * Joint reading: its range and the sense of its sign.
 *
 * unit : m or rad.
 * low, high : range of the slider.
 * stated : whether this is the range of the mechanism file; otherwise it is an assumption.
 * legs : indices of the legs that it moves.
 * direction, zero : sentences on the effect of a larger reading, and on the position at zero.
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
 * Configurations with one reading changed from home; null where no pose was found.
 */
export interface Sweep {
  values: number[];
  configurations: (Configuration | null)[];
}
/**
 * Quantity over the workspace.
 *
 * unit : mm or °; empty for a ratio.
 * better : whether small or large values are good.
 * limit : value at which the field for a wanted accuracy starts.
 * slices : its values in each slice.
 * evenly : its values at poses spread evenly over the workspace and its orientations, from which
 *     shares are computed.
 */
export interface MapLayer {
  name: string;
  component: "position" | "orientation";
  unit: string;
  better: "small" | "large";
  limit: number;
  slices: (number | null)[][][];
  evenly: number[];
}
/**
 * Measured pose in a slice, mm.
 */
export interface MapPose {
  key: string;
  tip: string;
  u: number;
  v: number;
}
/**
 * Plane of positions at home's orientation, mm.
 *
 * across, up, normal : names of the axes.
 * level : coordinate along the normal.
 * u, v : coordinates of the columns and rows.
 * poses : measured poses near the plane.
 */
export interface MapSlice {
  across: string;
  up: string;
  normal: string;
  level: number;
  u: number[];
  v: number[];
  poses: MapPose[];
}
/**
 * Plots side by side where there is room.
 */
export interface Panels {
  kind: "panels";
  plots: Plot[];
}
/**
 * Plot in the plane.
 *
 * caption : how to read it.
 * alt : description for readers who cannot see it.
 * marks : from back to front.
 * equal : same scale on both axes.
 */
export interface Plot {
  kind: "plot";
  name: string;
  title: string;
  caption: string;
  alt: string;
  x: PlotAxis;
  y: PlotAxis;
  marks: (LineMark | DotsMark | BarsMark | BoxesMark | BandMark | RuleMark | CellsMark)[];
  colours: ColourScale | null;
  equal: boolean;
}
/**
 * Axis of a plot.
 *
 * label : quantity and unit, such as "rms, mm"; may be empty.
 * scale : of numbers, or one place for each of ``categories``.
 * limits : values at the ends of an axis of numbers; the first may be the larger one.
 * ticks : labels of an axis of numbers.
 */
export interface PlotAxis {
  label: string;
  scale: "linear" | "log" | "categories";
  limits: [number, number] | null;
  ticks: Tick[];
  categories: string[];
}
/**
 * Straight line at a value of an axis, over the whole of the other one.
 */
export interface RuleMark {
  mark: "rule";
  name: string;
  axis: "x" | "y";
  at: number;
  colour:
    | "nominal"
    | "calibrated"
    | "quiet"
    | "ink"
    | "good"
    | "warn"
    | "bad"
    | "leg-1"
    | "leg-2"
    | "leg-3"
    | "leg-4"
    | "leg-5"
    | "leg-6"
    | "leg-7"
    | "leg-8";
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
 * Report of a command.
 *
 * kicker : line above the title. subject : what was examined. origin : date, program, digest.
 * notes : the user's own text.
 * warnings, advice, remarks : sentences below the verdict; remarks need no action.
 * certificate : tolerances and instruments, for the first printed page.
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
  certificate: Fact[];
  sections: Section[];
}
/**
 * Judgement at the top of a report.
 *
 * tone : good, partial (with exceptions or doubts), bad, or neutral (nothing is judged).
 * stamp : one to three words.
 * explanation : line below the headline.
 * reasons : points below both.
 * comparison : magnitudes before and after.
 */
export interface Verdict {
  tone: "good" | "partial" | "bad" | "neutral";
  stamp: string;
  headline: string;
  explanation: string;
  comparison: LogBar | null;
  reasons: string[];
}
/**
 * Section of a report.
 *
 * menu : its name in the table of contents.
 * expert : collapsed, among the sections for the metrologist.
 * void : its figures mean nothing, because the result must not be used.
 */
export interface Section {
  name: string;
  title: string;
  menu: string;
  expert: boolean;
  void: boolean;
  blocks: (
    Paragraph | Hint | Listing | Facts | Downloads | DataTable | LogBar | Plot | Panels | Images | Space | ToolMapBlock
  )[];
}
/**
 * Stage with a machine.
 *
 * alt : description for readers who do not see the stage.
 * poses : configurations of the slider; with none the machine stays at home.
 * names : of the machine before and after ``changes``; the configurations are those after.
 * changes : of each leg; one entry for all poses, or one for each of them; none without a second
 *     machine.
 * enlargement : of changes and arrows at the start; a slider changes it.
 * sigmas : standard deviations of the ellipsoids.
 * ellipsoid_enlargement : of the ellipsoids at the start; likewise.
 */
export interface Space {
  kind: "space";
  title: string;
  caption: string;
  alt: string;
  machine: Machine;
  poses: SpacePose[];
  /**
   * @minItems 2
   * @maxItems 2
   */
  names: [string, string];
  changes: LegChange[][];
  ellipsoids: Ellipsoid[];
  enlargement: number;
  sigmas: number;
  ellipsoid_enlargement: number;
  points: SpacePoints[];
  arrows: SpaceArrows[];
  paths: SpacePath[];
}
/**
 * Configuration of the slider; label : its name.
 */
export interface SpacePose {
  key: string;
  label: string;
  configuration: Configuration;
}
/**
 * Points with a name in the legend.
 *
 * colour : custom property of the style sheet.
 * keys, tips : of each point.
 * sizes : relative to others; empty for all alike.
 * visible : whether they are drawn from the start.
 */
export interface SpacePoints {
  name: string;
  colour: string;
  points: [number, number, number][];
  keys: string[];
  tips: string[];
  sizes: number[];
  visible: boolean;
}
/**
 * Small vectors at points, m; drawn enlarged.
 */
export interface SpaceArrows {
  name: string;
  colour: string;
  points: [number, number, number][];
  vectors: [number, number, number][];
  tips: string[];
  visible: boolean;
}
/**
 * Polylines with a name in the legend, m, base frame.
 */
export interface SpacePath {
  name: string;
  colour: string;
  lines: [number, number, number][][];
  dashed: boolean;
}
/**
 * Contour maps with a choice of layer and slice.
 */
export interface ToolMapBlock {
  kind: "tool_map";
  caption: string;
  alt: string;
  slices: MapSlice[];
  layers: MapLayer[];
}
/**
 * Page of a session, which requests images, overlays and the stage from the program.
 *
 * legs : number of legs.
 * calibration : its folder; empty for none. report : address of its report, relative to the page;
 *     empty for none.
 */
export interface SessionDocument {
  version: 1;
  program: string;
  title: string;
  kind: "session";
  legs: number;
  calibration: string;
  report: string;
  stations: SessionStation[];
}
/**
 * Station with its images.
 *
 * legs : whether it can be localized by the legs in its images.
 * handheld : a single image by hand.
 * posed : whether session.yaml has its pose.
 * images : without overlays, which the page requests.
 */
export interface SessionStation {
  name: string;
  legs: boolean;
  handheld: boolean;
  posed: boolean;
  images: Image[];
}
/**
 * Measurements in one image against the overlaid machine.
 *
 * mark : whether the image fits; null where nothing can be compared.
 * texts : sentences on the agreement.
 * reasons : sentences on the edges that were not measured.
 * median : median offset of the edges, px; null without any.
 * layers : measured and missing edges, and corners of a board.
 */
export interface EdgesAnswer {
  mark: "good" | Level | null;
  texts: string[];
  legs: LegCount[];
  reasons: string[];
  median: number | null;
  layers: Layer[];
}
/**
 * Numbers of a leg's edges; leg : from 1. predicted : within the image.
 */
export interface LegCount {
  leg: number;
  measured: number;
  predicted: number;
}
/**
 * Drag from one pixel to another, or a change of the distance about a pixel.
 *
 * factor : ratio of the new distance to the old one.
 */
export interface Gesture {
  kind: "aim" | "turn" | "roll" | "distance";
  /**
   * @minItems 2
   * @maxItems 2
   */
  start: [number, number];
  /**
   * @minItems 2
   * @maxItems 2
   */
  end: [number, number];
  factor: number;
}
/**
 * Joint of the overlaid machine in the image; leg : from 1.
 */
export interface JointPixel {
  leg: number;
  end: "base" | "platform";
  /**
   * @minItems 2
   * @maxItems 2
   */
  at: [number, number];
}
/**
 * Result of a localization: the overlay at the pose, which is unchanged without success.
 *
 * places : poses between which a person can choose, likeliest first, without success.
 */
export interface LocalizationAnswer {
  localized: boolean;
  text: string;
  overlay: OverlayAnswer;
  places: [
    [number, number, number, number],
    [number, number, number, number],
    [number, number, number, number],
    [number, number, number, number]
  ][];
}
/**
 * Overlaid machine after the request's gesture and pins.
 *
 * place : the pose as session.yaml has it.
 * layers : the machine and its joints.
 */
export interface OverlayAnswer {
  /**
   * @minItems 4
   * @maxItems 4
   */
  pose: [
    [number, number, number, number],
    [number, number, number, number],
    [number, number, number, number],
    [number, number, number, number]
  ];
  place: Property[];
  layers: Layer[];
  joints: JointPixel[];
}
/**
 * What a person says of a pixel of an image: a leg's joint is there, or the leg itself.
 *
 * image : index in the station.
 * end : which joint; axis for any place along the leg.
 * leg : from 1.
 */
export interface Pin {
  image: number;
  end: ("base" | "platform") | "axis";
  leg: number;
  /**
   * @minItems 2
   * @maxItems 2
   */
  pixel: [number, number];
}
/**
 * A pose was written into session.yaml.
 */
export interface SavedAnswer {
  text: string;
}
/**
 * Request about an image with the machine to overlay.
 *
 * station, image : indices.
 * pose : None for the pose of the files.
 * anywhere : search the pose globally rather than near the given one.
 */
export interface ViewRequest {
  station: number;
  image: number;
  machine: "nominal" | "calibration";
  pose:
    | [
        [number, number, number, number],
        [number, number, number, number],
        [number, number, number, number],
        [number, number, number, number]
      ]
    | null;
  gesture: Gesture | null;
  pins: Pin[];
  anywhere: boolean;
}
