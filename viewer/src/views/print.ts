/** The page on paper: a certificate first, a running head, everything collapsed open. */

import type { Context } from "../blocks";
import type { ReportDocument } from "../document";
import { h } from "../dom";

/** Tolerances and instruments with room for a signature, below the verdict on the first page. */
export function certificate(content: ReportDocument): HTMLElement[] {
  if (!content.certificate.length) return [];
  return [h("section", { class: "certificate", "aria-label": "Certificate" },
    h("dl", { class: "facts" },
      ...content.certificate.flatMap((one) => [h("dt", {}, one.name), h("dd", {}, one.value)])),
    h("p", { class: "signature" }, h("span", {}, "Date, place"), h("span", {}, "Name"), h("span", {}, "Signature")))];
}

export function connectPrint(host: HTMLElement, content: ReportDocument, steps: Context["printSteps"]): void {
  const text = (words: readonly string[]): string => JSON.stringify(
    words.filter(Boolean).join(" · ").replaceAll(/[\s\p{Cc}]+/gu, " ").replaceAll("\"", "'"));
  const sheet = new CSSStyleSheet();
  sheet.replaceSync(`@page {
    @top-left { content: ${text([content.title, content.kicker])}; }
    @top-right { content: "page " counter(page) " of " counter(pages); }
    @bottom-left { content: ${text(content.origin)}; }
  }`);
  document.adoptedStyleSheets.push(sheet);

  let opened: HTMLDetailsElement[] = [];
  let undo: (() => void)[] = [];
  addEventListener("beforeprint", () => {
    // a section that is drawn here appends the steps of its own blocks
    for (const step of steps) {
      const back = step();
      if (back) undo.push(back);
    }
    opened = [...host.querySelectorAll<HTMLDetailsElement>("details:not([open])")];
    for (const details of opened) details.open = true;
  });
  addEventListener("afterprint", () => {
    for (const details of opened) details.open = false;
    for (const back of undo) back();
    undo = [];
  });
}
