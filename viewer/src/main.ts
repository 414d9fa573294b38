/** Entry: reads the document of the page and shows the view of its kind. */

import "./style.css";
import type { ViewerDocument } from "./document";
import { h } from "./dom";
import { machineView } from "./views/machine";

const VERSION = 1;
const VIEWS = { machine: machineView };

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
  VIEWS[content.kind](host, content);
}

start();
