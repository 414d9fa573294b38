/** Explanations of elements with `data-tip`: under the pointer, at the focus, or after a tap. */

import { h } from "./dom";

const MARGIN = 8;

export function connectTips(host: HTMLElement): void {
  const tip = h("div", { class: "tip", id: "tip", role: "tooltip", hidden: true });
  host.append(tip);
  let described: Element | null = null;
  const show = (event: Event): void => {
    const target = event.target as Element;
    // a row that has the focus shows the explanation of its name
    const row = event.type === "focusin" && target.matches("tr");
    const element = row
      ? target.querySelector<HTMLElement>("[data-tip]") : target.closest<HTMLElement>("[data-tip]");
    described?.removeAttribute("aria-describedby");
    described = element && target;
    tip.hidden = !element;
    if (!element) return;
    target.setAttribute("aria-describedby", tip.id);
    tip.textContent = element.dataset.tip ?? "";
    tip.style.left = tip.style.top = "0"; // the place would narrow the box that is measured
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
