// Builds the bundle that ships with the Python package: one script and one style sheet, each with
// the SHA-256 of the sources in its first line. tests/test_viewer.py computes the same hash.
import { createHash } from "node:crypto";
import { readFileSync, readdirSync } from "node:fs";
import { join } from "node:path";
import { defineConfig } from "vite";

const root = import.meta.dirname;
const SOURCES = ["package.json", "package-lock.json", "tsconfig.json", "vite.config.js", "src"];

function files(path) {
  const entry = readdirSync(join(root, path), { recursive: true, withFileTypes: true });
  return entry.filter((one) => one.isFile()).map((one) =>
    join(one.parentPath, one.name).slice(root.length + 1).replaceAll("\\", "/"));
}

function stamp() {
  const names = SOURCES.flatMap((name) => (name.includes(".") ? [name] : files(name)));
  const hash = createHash("sha256");
  for (const name of names.sort()) {
    const content = readFileSync(join(root, name));
    hash.update(`${name}\n${content.length}\n`).update(content);
  }
  return `/*! pkmcal viewer; sources sha256 ${hash.digest("hex")} */\n`;
}

const stamped = {
  name: "stamp",
  enforce: "post",
  generateBundle(_options, bundle) {
    for (const part of Object.values(bundle)) {
      if (part.type === "chunk") part.code = stamp() + part.code;
      else part.source = stamp() + part.source;
    }
  },
};

export default defineConfig({
  root,
  plugins: [stamped],
  build: {
    target: "es2022",
    outDir: process.env.BUNDLE ?? join(root, "../src/pkmcal/web/bundle"),
    emptyOutDir: false,
    modulePreload: false,
    reportCompressedSize: false,
    chunkSizeWarningLimit: 2000,
    lib: {
      entry: join(root, "src/main.ts"),
      formats: ["iife"],
      name: "pkmcalViewer",
      fileName: () => "viewer.js",
      cssFileName: "viewer",
    },
  },
});
