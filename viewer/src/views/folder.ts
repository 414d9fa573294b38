/** List of the sessions and results in a folder; each opens its page. */

import "./folder.css";
import type { FolderDocument, FolderEntry } from "../document";
import { h } from "../dom";
import { sign } from "../marks";

const COLUMNS = ["Name", "Contents", "Date", "Verdict", "Tool error"];

export function folderView(host: HTMLElement, content: FolderDocument): void {
  host.classList.add("folder");
  host.append(
    h("header", { class: "top" },
      h("p", { class: "kicker" }, content.program),
      h("h1", {}, content.title)),
    h("main", {},
      ...(content.note ? [h("p", { class: "folder-note" }, content.note)] : []),
      ...(content.entries.length
        ? [h("div", { class: "scroll" },
          h("table", { class: "data" },
            h("thead", {}, h("tr", {}, ...COLUMNS.map((name) => h("th", { scope: "col" }, name)))),
            h("tbody", {}, ...content.entries.map(row))))]
        : [])),
  );
}

function row(entry: FolderEntry): HTMLElement {
  const error = entry.before ? `${entry.before} → ${entry.after}` : "";
  return h("tr", {},
    h("th", { scope: "row" }, entry.href ? h("a", { href: entry.href }, entry.name) : entry.name),
    h("td", {}, entry.title),
    h("td", { class: "date" }, entry.date),
    h("td", {}, ...(entry.mark ? [sign(entry.mark), " "] : []), entry.text),
    h("td", { class: "error" }, error));
}
