/** Entry: reads the document of the page and shows the view of its kind. */

import "./style.css";
import type { ViewerDocument } from "./document";
import { h } from "./dom";
import { machineView } from "./views/machine";
import { reportView } from "./views/report";

const VERSION = 1;

function start(): void {
  const host = document.getElementById("viewer");
  const source = document.getElementById("document");
  if (!host || !source) return;
  const content = JSON.parse(source.textContent ?? "") as ViewerDocument;
  host.replaceChildren();
  if (content.version !== VERSION) {
    host.append(h("p", { class: "note" }, "This page was written by another version of pkmcal."));
    return;
  }
  if (content.kind === "machine") machineView(host, content);
  else reportView(host, content);
}

start();
