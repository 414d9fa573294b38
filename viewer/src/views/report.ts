/** Report of a command: verdict, findings, cards and sections, with a table of contents. */

import "./report.css";
import { drawBlock, type Context } from "../blocks";
import { logBar } from "../blocks/log_bar";
import type { Card, ReportDocument, Section } from "../document";
import { h, prose } from "../dom";
import { sign, type Mark } from "../marks";
import { ImageViewer } from "../image_viewer";
import { hrefOf } from "../overlay";
import { connect, Selection } from "../selection";
import { connectTips } from "../tips";
import { startExponent } from "../tones";
import { contents } from "./contents";
import { certificate, connectPrint } from "./print";

const TONE_MARKS: Record<ReportDocument["verdict"]["tone"], Mark | null> = {
  good: "good",
  partial: "doubtful",
  bad: "wrong",
  neutral: null,
};

const LONG_HEADLINE = 110; // characters, from which on a smaller font keeps it in two lines

export function reportView(host: HTMLElement, content: ReportDocument): void {
  const selection = new Selection();
  const viewer = new ImageViewer(selection);
  const context: Context = { selection, viewer, printSteps: [] };
  const sections = content.sections.map((section) => sectionOf(section, context));
  host.classList.add("report");
  host.append(
    h("header", { class: "top" },
      h("p", { class: "kicker" }, `pkmcal · ${content.kicker}`),
      h("h1", {}, content.title),
      ...(content.subject ? [h("p", { class: "small" }, content.subject)] : []),
      h("p", { class: "small origin" }, content.origin.join(" · "))),
    contents(content.sections, sections),
    h("main", {},
      verdictOf(content),
      ...certificate(content),
      ...findingsOf(content),
      ...(content.cards.length ? [cardsOf(content.cards, content.sections.some((one) => one.void))] : []),
      ...sections),
    viewer.dialog,
  );
  connect(host, selection);
  connectTips(host);
  connectPrint(host, content, context.printSteps);
}

function verdictOf({ verdict }: ReportDocument): HTMLElement {
  const mark = TONE_MARKS[verdict.tone];
  return h("section", { class: `verdict ${verdict.tone}`, "aria-labelledby": "verdict" },
    h("p", { class: "stamp" }, ...(mark ? [sign(mark), " "] : []), verdict.stamp),
    h("h2", { id: "verdict", class: verdict.headline.length > LONG_HEADLINE && "long" }, verdict.headline),
    ...(verdict.explanation ? [h("p", { class: "explanation" }, ...prose(verdict.explanation))] : []),
    ...(verdict.reasons.length ? [h("ul", { class: "reasons" }, ...items(verdict.reasons))] : []),
    ...(verdict.comparison ? [logBar(verdict.comparison)] : []));
}

const items = (texts: readonly string[]): HTMLElement[] => texts.map((text) => h("li", {}, ...prose(text)));

/** The user's notes, warnings, advice and remarks; a list of several remarks is collapsed. */
function findingsOf(content: ReportDocument): HTMLElement[] {
  const lists: HTMLElement[] = [];
  const add = (heading: string, kind: string, texts: readonly string[]): void => {
    if (texts.length) lists.push(h("div", { class: `box ${kind}` }, h("h3", {}, heading), h("ul", {}, ...items(texts))));
  };
  add("Look at this", "warn", content.warnings);
  add("What would help", "", content.advice);
  if (content.remarks.length) {
    const count = content.remarks.length === 1 ? "1 remark" : `${content.remarks.length} remarks`;
    lists.push(h("details", { class: "box" }, h("summary", {}, `${count} without effect on the result`),
      h("ul", {}, ...items(content.remarks))));
  }
  const own = content.notes
    ? [h("section", { class: "box own", "aria-label": "Notes" }, h("h3", {}, "Notes"), h("p", {}, content.notes))]
    : [];
  return [...own, ...(lists.length ? [h("section", { class: "notes", "aria-label": "Findings" }, ...lists)] : [])];
}

function cardsOf(cards: readonly Card[], refused: boolean): HTMLElement {
  return h("section", { class: refused ? "refused" : "", "aria-label": "Main numbers" },
    ...(refused ? [h("p", { class: "void" }, "Figures of a refused result: they show why, and hold for nothing else.")] : []),
    h("ul", { class: "cards" }, ...cards.map((card) =>
      h("li", { class: "card" },
        h("h3", {}, card.question),
        h("p", { class: "value" }, ...card.values.map(([value, unit]) =>
          h("span", { class: "pair" }, h("b", {}, value), unit === "°" ? "" : " ", h("span", { class: "unit" }, unit)))),
        ...(card.limit
          ? [h("p", { class: `limit ${card.mark ?? ""}` }, ...(card.mark ? [sign(card.mark), " "] : []), card.limit)]
          : []),
        h("p", { class: "small" }, card.note)))));
}

function sectionOf(section: Section, context: Context): HTMLElement {
  const title = h("h2", { id: `${section.name}-title` }, section.title);
  const blocks = (): HTMLElement[] => [
    ...(section.void ? [h("p", { class: "void" }, "The result is refused: these figures mean nothing.")] : []),
    ...section.blocks.map((block) => drawBlock(block, context)),
  ];
  const element = h("section", {
    id: section.name,
    class: section.void ? "refused" : "",
    "aria-labelledby": `${section.name}-title`,
  });
  if (!section.expert) {
    element.append(title, ...blocks());
    return element;
  }
  // a collapsed section is drawn when it is first opened, or printed: its images are measured before
  const images = section.blocks.flatMap((block) => (block.kind === "images" ? block.images : []));
  for (const image of images) void startExponent(hrefOf(image));
  const details = h("details", { class: "expert" }, h("summary", {}, title));
  const draw = (): void => { if (details.childElementCount === 1) details.append(...blocks()); };
  details.addEventListener("toggle", draw);
  context.printSteps.push(draw);
  element.append(details);
  return element;
}
