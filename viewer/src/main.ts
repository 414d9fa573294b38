/** Entry: reads the document of the page and shows the view of its kind. */

import "./style.css";
import type { ViewerDocument } from "./document";
import { h } from "./dom";
import { folderView } from "./views/folder";
import { machineView } from "./views/machine";
import { reportView } from "./views/report";
import { sessionView } from "./views/session";

const VERSION = 1;

function start(): void {
  const host = document.getElementById("viewer");
  const source = document.getElementById("document");
  if (!host || !source) return;
  const content = JSON.parse(source.textContent ?? "") as ViewerDocument;
  host.replaceChildren();
  if (content.version !== VERSION) {
    host.append(h("p", { class: "box" }, "This page was written by another version of pkmcal."));
    return;
  }
  switch (content.kind) {
    case "machine": return machineView(host, content);
    case "report": return reportView(host, content);
    case "session": return sessionView(host, content);
    case "folder": return folderView(host, content);
  }
}

start();
