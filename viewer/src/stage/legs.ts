/** Legs in the page's text: chips with their number and colour, and tables of their values. */

import type { Machine } from "../document";
import { h } from "../dom";
import { legClass } from "../marks";

export const chip = (leg: number): HTMLElement =>
  h("span", { class: `chip ${legClass(leg + 1)}` }, String(leg + 1));

export function legTable(machine: Machine, leg: number): HTMLElement {
  const { rows, number: name } = machine.legs[leg];
  return h(
    "table",
    { class: "values" },
    h("caption", {}, `Leg ${name}`),
    h("tbody", {}, ...rows.map((row) => h("tr", {}, h("th", { scope: "row" }, row.label), h("td", {}, row.value)))),
  );
}
