// Writes src/document.ts, the types of the document, from the schema that Python publishes.
import { readFile, writeFile } from "node:fs/promises";
import { compile } from "json-schema-to-typescript";

const schema = JSON.parse(
  await readFile(new URL("../../src/pkmcal/web/schema.json", import.meta.url), "utf8"),
);
// Python writes every field, also those with a default, except where a field says otherwise
for (const part of [schema, ...Object.values(schema.$defs)]) {
  if (!part.properties) continue;
  part.required = Object.keys(part.properties).filter((name) => !part.properties[name].omittedAtDefault);
  for (const one of Object.values(part.properties)) delete one.omittedAtDefault;
}
// a title on each field would become a type of its own; tuples are written as before 2020-12
const strip = (node) => {
  if (Array.isArray(node)) node.forEach(strip);
  else if (node && typeof node === "object") {
    if (node.prefixItems) {
      node.items = node.prefixItems;
      delete node.prefixItems;
    }
    for (const [key, value] of Object.entries(node)) {
      if (key === "properties") for (const one of Object.values(value)) delete one.title;
      strip(value);
    }
  }
};
strip(schema);
// an object with every type, so that those of a served page's messages are generated too
const { $defs, oneOf } = schema;
const every = { ...$defs, ViewerDocument: { oneOf } };
const properties = Object.fromEntries(
  Object.keys(every).map((name) => [name, { $ref: `#/$defs/${name}` }]),
);
const root = { type: "object", properties, required: Object.keys(every), $defs: every };
const text = await compile(root, "EveryType", {
  additionalProperties: false,
  bannerComment: "// Generated from src/pkmcal/web/schema.json by `npm run types`; do not edit.",
});
const target = process.argv[2] ?? new URL("../src/document.ts", import.meta.url);
await writeFile(target, text);
