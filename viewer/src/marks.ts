/** Signs of rows, cards, sections and findings, with their words for screen readers. */

import type { Level } from "./document";
import { h } from "./dom";

export type Mark = "good" | Level;
const SIGNS: Record<Mark, [string, string]> = {
  good: ["✓", "good"],
  note: ["·", "note"],
  doubtful: ["!", "warning"],
  wrong: ["✕", "wrong"],
};

export const sign = (mark: Mark): HTMLElement =>
  h("span", { class: `sign ${mark}`, role: "img", "aria-label": SIGNS[mark][1] }, SIGNS[mark][0]);

const LEG_COLOURS = 8;
/** Class with a leg's colour as `--c`; machines with more legs repeat the colours. */
export const legClass = (leg: number): string => `leg-${((leg - 1) % LEG_COLOURS) + 1}`;
/** Likewise of a leg's key, such as `leg:3`; empty for another key. */
export const keyClass = (key: string): string => (key.startsWith("leg:") ? legClass(Number(key.slice(4))) : "");
