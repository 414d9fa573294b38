/** Explanations of elements with `data-tip`: under the pointer, at the focus, or after a tap. */

import { h } from "./dom";

const MARGIN = 8;

export function connectTips(host: HTMLElement): void {
  const tip = h("div", { class: "tip", role: "tooltip", hidden: true });
  host.append(tip);
  const show = (event: Event): void => {
    const element = (event.target as Element).closest<HTMLElement>("[data-tip]");
    tip.hidden = !element;
    if (!element) return;
    tip.textContent = element.dataset.tip ?? "";
    const box = element.getBoundingClientRect(), own = tip.getBoundingClientRect();
    const left = Math.min(Math.max(box.left, MARGIN), innerWidth - own.width - MARGIN);
    const above = box.top - own.height - MARGIN;
    tip.style.left = `${left}px`;
    tip.style.top = `${above > MARGIN ? above : box.bottom + MARGIN}px`;
  };
  host.addEventListener("pointerover", show);
  host.addEventListener("focusin", show);
  addEventListener("scroll", () => { tip.hidden = true; }, { passive: true, capture: true });
  addEventListener("keydown", (event) => { if (event.key === "Escape") tip.hidden = true; });
}
