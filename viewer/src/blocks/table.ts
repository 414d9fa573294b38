/** Table: sorted by its headings, filtered by buttons, copied as TSV or YAML. */

import "./table.css";
import type { Column, DataTable, TableRow } from "../document";
import { h } from "../dom";
import { legClass, sign } from "../marks";
import type { Context } from "./index";
import { copyText, tsv, yaml } from "./table_text";

/** Rows of a long table before all are asked for, and from how many rows on a table is long. */
const FIRST_ROWS = 12, LONG = 18;
const SORTABLE = 3, COPYABLE = 4;
/** Letters of a row's name that stays on one line, and of a text that needs no width of its own. */
const SHORT_NAME = 16;

export function dataTable(block: DataTable, { selection, printSteps }: Context): HTMLElement {
  const most = Math.max(...block.rows.flatMap((row) =>
    row.values.filter((_, k) => block.columns[k]?.form === "shade").map((value) => value ?? 0)));
  const drawn = block.rows.map((row) => tableRow(row, block.columns, most));
  const body = h("tbody", {}, ...drawn);
  const sorting = new Sorting(block);
  const pressed = new Set<string>();
  let all = block.rows.length <= LONG;

  const heads = block.columns.map((column, k) => {
    const attributes = { class: column.form, "data-tip": column.hint || false };
    const focus = { tabindex: column.hint ? 0 : false };
    if (!column.name) return h("td", { ...attributes, ...focus });
    if (block.rows.length < SORTABLE) return h("th", { scope: "col", ...attributes, ...focus }, column.name);
    const button = h("button", { type: "button", onclick: () => { sorting.next(k); update(); } }, column.name);
    return h("th", { scope: "col", ...attributes }, button);
  });
  const more = h("button", { type: "button", class: "more", onclick: () => { all = true; update(); } });
  const table = h("table", { class: "data" }, h("thead", {}, h("tr", {}, ...heads)), body);

  /** Indices of the rows that pass the filters, in the order of the sorting. */
  const passing = (): number[] => sorting.order().filter((k) => passes(block, block.rows[k]!, pressed));
  const update = (): void => {
    const rows = passing();
    const visible = all ? rows : rows.slice(0, FIRST_ROWS);
    body.replaceChildren(...visible.map((k) => drawn[k]!));
    selection.apply(body);
    markGroups(visible, block, drawn, sorting.column < 0);
    heads.forEach((head, k) => {
      if (k === sorting.column) head.setAttribute("aria-sort", sorting.down ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    });
    more.hidden = visible.length === rows.length;
    more.textContent = `All ${rows.length} rows`;
  };

  const filters = block.filters.map((filter) => {
    const button = h("button", { type: "button", class: "filter", "aria-pressed": "false" }, filter.label);
    button.addEventListener("click", () => {
      if (pressed.has(filter.tag)) pressed.delete(filter.tag);
      else pressed.add(filter.tag);
      button.setAttribute("aria-pressed", String(pressed.has(filter.tag)));
      update();
    });
    return button;
  });
  const copy = (label: string, text: (rows: TableRow[]) => string): HTMLElement => {
    const button = h("button", { type: "button", class: "copy" }, label);
    button.addEventListener("click", async () => {
      const done = await copyText(text(passing().map((k) => block.rows[k]!)));
      button.textContent = done ? "Copied" : "Not copied";
      setTimeout(() => { button.textContent = label; }, 1500);
    });
    return button;
  };
  const copies = block.rows.length < COPYABLE ? [] : [
    h("span", { class: "copies" }, "Copy as ",
      copy("TSV", (rows) => tsv(block.columns, rows)), copy("YAML", (rows) => yaml(block.columns, rows)))];
  update();

  const title = block.title && !block.folded ? [h("h3", {}, block.title)] : [];
  const tools = filters.length ? [h("div", { class: "tools" }, ...filters, ...copies)] : copies;
  const content = [
    ...(filters.length ? [...title, ...tools] : [h("div", { class: "tools" }, ...title, ...tools)]),
    scrollable(table, block.title || block.columns.map((column) => column.name).join(", ")),
    more,
    ...explanations(block.columns),
    ...(block.note ? [h("p", { class: "small" }, block.note)] : []),
  ];
  printSteps.push(() => {
    const before = all;
    all = true;
    update();
    return () => { all = before; update(); };
  });
  if (block.folded) return h("details", {}, h("summary", {}, block.title), ...content);
  return h("div", { class: "data-table" }, ...content);
}

/** The columns' explanations, for paper, where nothing can be pointed at. */
function explanations(columns: Column[]): HTMLElement[] {
  const named = new Map<string, string[]>();
  for (const { name, hint } of columns) if (hint) named.set(hint, [...(named.get(hint) ?? []), name]);
  if (!named.size) return [];
  const items = [...named].map(([hint, names]) => h("li", {}, h("b", {}, names.join(", ")), `: ${hint}`));
  return [h("ul", { class: "explanations" }, ...items)];
}

/** Area that scrolls sideways, and is reached by the keyboard as long as there is anything to scroll. */
function scrollable(table: HTMLElement, label: string): HTMLElement {
  const area = h("div", { class: "scroll", role: "region", "aria-label": label }, table);
  new ResizeObserver(() => {
    area.tabIndex = area.scrollWidth > area.clientWidth ? 0 : -1;
  }).observe(area);
  return area;
}

class Sorting {
  column = -1;
  down = false;
  constructor(private readonly block: DataTable) {}

  /** Sort by a column: numbers from the largest on first, then the other way, then as given. */
  next(column: number): void {
    const first = this.numeric(column);
    if (column !== this.column) [this.column, this.down] = [column, first];
    else if (this.down === first) this.down = !first;
    else this.column = -1;
  }

  order(): number[] {
    const { column, block } = this, rows = block.rows.map((_, k) => k);
    if (column < 0) return rows;
    const numeric = this.numeric(column), turn = this.down ? -1 : 1;
    return rows.sort((a, b) => {
      const [p, q] = [block.rows[a]!, block.rows[b]!];
      if (!numeric) return turn * p.cells[column]!.localeCompare(q.cells[column]!, "en", { numeric: true });
      const [x, y] = [p.values[column] ?? null, q.values[column] ?? null];
      if (x === null || y === null) return (x === null ? 1 : 0) - (y === null ? 1 : 0); // without a number: last
      return turn * (this.size(column, x) - this.size(column, y));
    });
  }

  private size(column: number, value: number): number {
    return this.block.columns[column]!.by_size ? Math.abs(value) : value;
  }

  private numeric(column: number): boolean {
    return this.block.columns[column]!.form !== "text" && this.block.rows.some((row) => row.values[column] != null);
  }
}

function passes(block: DataTable, row: TableRow, pressed: Set<string>): boolean {
  const groups = new Map<string, string[]>();
  for (const filter of block.filters) {
    if (filter.hides) {
      if (row.tags.includes(filter.tag) && !pressed.has(filter.tag)) return false;
    } else if (pressed.has(filter.tag)) {
      groups.set(filter.group, [...(groups.get(filter.group) ?? []), filter.tag]);
    }
  }
  return [...groups.values()].every((tags) => tags.some((tag) => row.tags.includes(tag)));
}

/** Row of a table; `most` is the largest value of the shaded columns. */
function tableRow(row: TableRow, columns: Column[], most: number): HTMLTableRowElement {
  const cells = columns.map((column, k) => {
    const text = row.cells[k] ?? "", children = cellContent(column, text, row.values[k] ?? null);
    const first = k === columns.findIndex((one) => one.form === "text");
    if (!first) {
      const value = column.form === "chance" ? row.values[k] ?? null : null;
      const long = column.form === "text" && text.length > SHORT_NAME;
      const cell = h("td", { class: `${column.form}${long ? " long" : ""}`, "data-tip": value !== null && value.toPrecision(2) }, ...children);
      if (column.form === "shade") cell.style.setProperty("--share", String((row.values[k] ?? 0) / most));
      return cell;
    }
    const attributes = {
      scope: "row", class: `${column.form}${text.length <= SHORT_NAME ? " short" : ""}`, "data-tip": row.hint || false, tabindex: row.hint && !row.key ? 0 : false,
    };
    return h("th", attributes, ...(row.mark ? [sign(row.mark), " "] : []), ...children);
  });
  const classes = row.quiet ? "quiet" : "";
  return h("tr", { class: classes, "data-key": row.key || false, tabindex: row.key ? 0 : false }, ...cells);
}

function cellContent(column: Column, text: string, value: number | null): (Node | string)[] {
  if (column.form === "leg") return value === null ? [text] : [h("span", { class: `chip ${legClass(value)}` }, text)];
  if (column.form === "share" && value !== null) {
    const bar = h("i", {});
    bar.style.width = `${100 * Math.min(Math.max(value, 0), 1)}%`;
    return [h("span", { class: "share-bar", "aria-hidden": "true" }, bar), text];
  }
  const [main, spread] = text.split(" ± ");
  return spread === undefined ? [text] : [main!, h("span", { class: "small" }, ` ± ${spread}`)];
}

/** A line above the first row of each leg, in the order as given. */
function markGroups(visible: number[], block: DataTable, drawn: HTMLElement[], asGiven: boolean): void {
  const leg = block.columns.findIndex((column) => column.form === "leg");
  visible.forEach((k, place) => {
    const before = block.rows[visible[place - 1] ?? -1];
    const starts = asGiven && leg >= 0 && before !== undefined && before.cells[leg] !== block.rows[k]!.cells[leg];
    drawn[k]!.classList.toggle("group", starts);
  });
}
