/** Rows of a table as text for other programs. */

import type { Column, TableRow } from "../document";

const DIGITS = 9;

/** Values of a row: numbers where the columns hold numbers, else texts. */
function values(columns: Column[], row: TableRow): (number | string)[] {
  return columns.map((column, k) => {
    const value = column.form === "text" ? null : row.values[k] ?? null;
    return value === null ? row.cells[k] ?? "" : Number(value.toPrecision(DIGITS));
  });
}

function named(columns: Column[], rows: TableRow[]): { names: string[]; table: (number | string)[][] } {
  const own = rows.some((row) => row.name);
  return {
    names: [...(own ? ["Name"] : []), ...columns.map((column, k) => column.name || `Column ${k + 1}`)],
    table: rows.map((row) => [...(own ? [row.name] : []), ...values(columns, row)]),
  };
}

export function tsv(columns: Column[], rows: TableRow[]): string {
  const { names, table } = named(columns, rows);
  const lines = [names, ...table].map((line) => line.map((cell) => String(cell).replaceAll(/\s+/g, " ")).join("\t"));
  return `${lines.join("\n")}\n`;
}

/** A list of mappings; JSON strings are YAML strings. */
export function yaml(columns: Column[], rows: TableRow[]): string {
  const { names, table } = named(columns, rows);
  return table.map((line) =>
    line.map((cell, k) => `${k ? "  " : "- "}${JSON.stringify(names[k])}: ${JSON.stringify(cell)}\n`).join("")).join("");
}

/** Put a text on the clipboard; also in frames, in which browsers refuse their newer interface. */
export async function copyText(text: string): Promise<boolean> {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    const area = document.createElement("textarea");
    area.value = text;
    document.body.append(area);
    area.select();
    const done = document.execCommand("copy");
    area.remove();
    return done;
  }
}
