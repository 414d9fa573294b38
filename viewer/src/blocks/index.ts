/** Blocks of a section by their kind: each file beside this one draws one or a few of them. */

import type { Section } from "../document";
import type { ImageViewer } from "../image_viewer";
import { h } from "../dom";
import type { Selection } from "../selection";
import { images } from "./images";
import { logBar } from "./log_bar";
import { panels, plot } from "./plot";
import { space } from "./space";
import { dataTable } from "./table";
import { downloads, facts, hint, listing, paragraph } from "./text";
import { tool_map } from "./tool_map";

export type Block = Section["blocks"][number];
/** What a block may use beside its own data. */
export interface Context {
  selection: Selection;
  viewer: ImageViewer;
  /** Steps before the page is printed; each may return the step that undoes it afterwards. */
  printSteps: (() => (() => void) | void)[];
}
type Of<K extends Block["kind"]> = Extract<Block, { kind: K }>;
type Drawers = { [K in Block["kind"]]: (block: Of<K>, context: Context) => HTMLElement };

const DRAWERS: Drawers = {
  paragraph,
  hint,
  listing,
  facts,
  downloads,
  table: dataTable,
  log_bar: logBar,
  plot,
  panels,
  images,
  space,
  tool_map,
};

export function drawBlock(block: Block, context: Context): HTMLElement {
  const draw = DRAWERS[block.kind] as (block: Block, context: Context) => HTMLElement;
  try {
    return draw(block, context);
  } catch (error) {
    console.error(error); // the other blocks of the page are drawn all the same
    return h("p", { class: "box" }, "This part of the page cannot be drawn.");
  }
}
