/** Magnitudes on a common logarithmic scale: a line for each, with a dot at its value. */

import "./log_bar.css";
import type { LogBar } from "../document";
import { h } from "../dom";

export function logBar(block: LogBar): HTMLElement {
  const logs = block.magnitudes.map((one) => Math.log10(one.value));
  const low = Math.floor(Math.min(...logs)), high = Math.max(low + 1, Math.ceil(Math.max(...logs)));
  const percent = (log: number): string => `${((log - low) / (high - low)) * 100}%`;
  const at = (element: HTMLElement, log: number): HTMLElement => {
    element.style.left = percent(log);
    return element;
  };
  const decades = Array.from({ length: high - low + 1 }, (_, k) => low + k);
  const grid = (): HTMLElement[] => decades.map((decade) => at(h("i", { class: "decade" }), decade));
  return h("figure", { class: "log-bar" },
    h("figcaption", {}, block.title),
    h("dl", {},
      ...block.magnitudes.flatMap((one, k) => [
        h("dt", {}, one.label),
        h("dd", { class: one.role },
          h("span", { class: "track", "aria-hidden": "true" }, ...grid(), at(h("b", {}), logs[k]!)),
          h("span", { class: "text" }, one.text)),
      ]),
      h("dt", { "aria-hidden": "true" }),
      h("dd", { class: "axis", "aria-hidden": "true" },
        h("span", { class: "track" }, ...decades.map((decade) =>
          at(h("span", {}, decade === high ? `${tick(decade)} ${block.unit}` : tick(decade)), decade))))),
    ...(block.note ? [h("p", { class: "small" }, block.note)] : []));
}

const tick = (decade: number): string => Number(`1e${decade}`).toString();
