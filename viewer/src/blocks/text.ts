/** Blocks of text. */

import type { Downloads, Facts, Hint, Listing, Paragraph } from "../document";
import { h, prose } from "../dom";

export const paragraph = (block: Paragraph): HTMLElement =>
  h("p", block.small ? { class: "small" } : {}, ...prose(block.text));

export const hint = (block: Hint): HTMLElement => h("p", { class: "small hint" }, ...prose(block.text));

export function listing(block: Listing): HTMLElement {
  const items = h("ul", { class: "listing" }, ...block.items.map((text) => {
    const [what, ...next] = text.split("\n");
    return h("li", {}, ...prose(what!), ...next.map((step) => h("span", { class: "step" }, ...prose(step))));
  }));
  if (block.folded) return h("details", {}, h("summary", {}, block.title), items);
  return h("div", {}, ...(block.title ? [h("h3", {}, block.title)] : []), items);
}

export const facts = (block: Facts): HTMLElement =>
  h("div", {},
    ...(block.title ? [h("h3", {}, block.title)] : []),
    h("dl", { class: "facts" },
      ...block.facts.flatMap((one) => [h("dt", {}, one.name), h("dd", {}, one.value)])));

export function downloads(block: Downloads): HTMLElement {
  const links = block.files.map((file) => {
    const link = h("a", { download: file.name, href: "#" }, file.name);
    let url = "";
    const prepare = (): void => {
      url ||= URL.createObjectURL(new Blob([file.content], { type: file.media_type }));
      link.href = url;
    };
    for (const event of ["pointerdown", "focus", "click"]) link.addEventListener(event, prepare);
    return link;
  });
  return h("p", { class: "downloads small" }, "Downloads: ",
    ...links.flatMap((link, k) => (k ? [", ", link] : [link])), ".");
}
