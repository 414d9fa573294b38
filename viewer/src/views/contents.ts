/** Table of contents: marks the section in view, and opens a collapsed one that it leads to. */

import type { Section } from "../document";
import { h } from "../dom";

export function contents(sections: readonly Section[], elements: readonly HTMLElement[]): HTMLElement {
  const links = sections.map((section) =>
    h("a", { href: `#${section.name}` }, section.menu));
  const first = sections.findIndex((section) => section.expert);
  const entries = links.flatMap((link, k) =>
    k === first ? [h("span", { class: "part" }, "For the metrologist"), link] : [link]);
  const nav = h("nav", { class: "contents", "aria-label": "Sections" }, h("a", { href: "#verdict" }, "Result"), ...entries);

  const observer = new IntersectionObserver((changes) => {
    for (const { target, isIntersecting } of changes) {
      const link = links[elements.indexOf(target as HTMLElement)];
      if (isIntersecting) link?.setAttribute("aria-current", "true");
      else link?.removeAttribute("aria-current");
    }
  }, { rootMargin: "-15% 0px -80% 0px" }); // a line near the top of the window
  for (const element of elements) observer.observe(element);

  const reveal = (): void => {
    const target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
    const details = target?.querySelector<HTMLDetailsElement>(":scope > details.expert") ?? target?.closest("details");
    if (!details || details.open) return;
    details.open = true;
    target?.scrollIntoView();
  };
  addEventListener("hashchange", reveal);
  nav.addEventListener("click", () => setTimeout(reveal)); // also a second click on the same link
  setTimeout(reveal);
  return nav;
}
