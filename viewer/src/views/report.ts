/** Report of a command: verdict, findings, cards and sections. */

import { drawBlock, type Context } from "../blocks";
import type { ReportDocument } from "../document";
import { h } from "../dom";
import { connect, Selection } from "../selection";

export function reportView(host: HTMLElement, content: ReportDocument): void {
  const context: Context = { selection: new Selection() };
  const { verdict } = content;
  host.classList.add("report");
  host.append(
    h("header", { class: "top" },
      h("p", { class: "kicker" }, content.kicker),
      h("h1", {}, content.title),
      h("p", { class: "small" }, content.subject)),
    h("main", {},
      h("section", { class: `verdict ${verdict.tone}` },
        h("p", { class: "stamp" }, verdict.stamp),
        h("h2", {}, verdict.headline),
        h("ul", {}, ...verdict.reasons.map((text) => h("li", {}, text)))),
      ...content.sections.map((section) =>
        h("section", { id: section.name },
          h("h2", {}, section.title),
          ...section.blocks.map((block) => drawBlock(block, context))))),
  );
  connect(host, context.selection);
}
