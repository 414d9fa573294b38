/** Shapes that are made once and placed anew for each configuration. */

import {
  ConeGeometry,
  CylinderGeometry,
  Group,
  type Material,
  Mesh,
  MeshBasicMaterial,
  Quaternion,
  Vector3,
} from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import type { Palette } from "./palette";

export type Point = [number, number, number];

const UP = new Vector3(0, 1, 0);
const CYLINDER = new CylinderGeometry(1, 1, 1, 28);
const CONE = new ConeGeometry(1, 2.6, 20);

export const vector = (p: Point): Vector3 => new Vector3(...p);

/** Turn that takes a shape's own axis, y, to a direction. */
const along = (direction: Vector3): Quaternion =>
  new Quaternion().setFromUnitVectors(UP, direction);

/** Cylinder between two points. */
export class Rod {
  readonly mesh: Mesh;

  constructor(
    material: Material,
    private readonly radius: number,
  ) {
    this.mesh = new Mesh(CYLINDER, material);
  }

  place(a: Vector3, b: Vector3): void {
    const line = b.clone().sub(a);
    const length = line.length();
    this.mesh.visible = length > 1e-9;
    if (!this.mesh.visible) return;
    this.mesh.scale.set(this.radius, length, this.radius);
    this.mesh.position.copy(a).addScaledVector(line, 0.5);
    this.mesh.quaternion.copy(along(line.divideScalar(length)));
  }
}

interface LineStyle {
  width?: number;
  dash?: number;
  opacity?: number;
  /** Whether the line is also drawn where something is in front of it. */
  over?: boolean;
}

/** Material of lines with a width in pixels. */
export function lineMaterial(palette: Palette, colour: string, style: LineStyle): LineMaterial {
  const { width = 2, dash = 0, opacity = 1, over = false } = style;
  return palette.paint(
    new LineMaterial({
      linewidth: width,
      dashed: dash > 0,
      dashSize: dash,
      gapSize: dash * 0.8,
      transparent: opacity < 1,
      opacity,
      depthTest: !over,
    }),
    colour,
  );
}

/** Polylines of one material. */
export class Lines {
  readonly object: LineSegments2;

  constructor(material: LineMaterial) {
    this.object = new LineSegments2(new LineSegmentsGeometry(), material);
    this.object.frustumCulled = false;
    if (!material.depthTest) this.object.renderOrder = 2;
  }

  place(lines: Point[][]): void {
    const ends = lines.flatMap((line) =>
      line.slice(1).flatMap((p, k) => [...line[k], ...p]),
    );
    this.object.visible = ends.length > 0;
    this.object.geometry.dispose();
    if (!this.object.visible) return;
    this.object.geometry = new LineSegmentsGeometry().setPositions(ends);
    this.object.computeLineDistances();
  }
}

/** Polyline with a head at its end, over all else and with a rim, so that it stands out. */
export class Arrow {
  readonly group = new Group();
  private readonly lines: Lines[];
  private readonly heads: Mesh[];

  constructor(palette: Palette, colour: string, size: number) {
    this.lines = [
      lineMaterial(palette, "--card", { width: 5.5, over: true }),
      lineMaterial(palette, colour, { width: 2.5, over: true }),
    ].map((material) => new Lines(material));
    this.heads = ["--card", colour].map((name, k) => {
      const material = new MeshBasicMaterial({ depthTest: false });
      const head = new Mesh(CONE, palette.paint(material, name));
      head.scale.setScalar(k ? size : 1.3 * size);
      return head;
    });
    const parts = [...this.lines.map((one) => one.object), ...this.heads];
    [0, 2, 1, 3].forEach((k, order) => (parts[k].renderOrder = 4 + order));
    this.group.add(...parts);
  }

  place(points: Point[]): void {
    this.group.visible = points.length > 1;
    if (!this.group.visible) return;
    for (const lines of this.lines) lines.place([points]);
    const [before, end] = points.slice(-2).map(vector);
    const turn = along(end.clone().sub(before).normalize());
    for (const head of this.heads) {
      head.position.copy(end);
      head.quaternion.copy(turn);
    }
  }
}
