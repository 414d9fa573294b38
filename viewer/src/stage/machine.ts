/** A machine on the stage: meshes and lines, placed anew for each configuration. */

import {
  Box3,
  BoxGeometry,
  BufferGeometry,
  DoubleSide,
  Float32BufferAttribute,
  Group,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  MeshStandardMaterial,
  Points,
  PointsMaterial,
  Quaternion,
  SphereGeometry,
  Vector3,
} from "three";
import type { Configuration, Leg, Machine } from "../document";
import { legClass } from "../marks";
import { Grid } from "./grid";
import type { Label } from "./labels";
import type { Palette } from "./palette";
import { Arrow, Lines, type Point, Rod, lineMaterial, vector } from "./shapes";
import type { Stage } from "./stage";

// sizes as shares of the machine's extent, for what has no size in the file
const ROD = 0.007;
const ARM = 0.012;
const BAR = 0.011;
const RAIL = 0.008;
const JOINT = 0.011;
const CARRIAGE = 0.05;
const MOTOR = 0.024;
const AXIS = 0.09;
const FRAME = 0.17;
const HEAD = 0.011;
const DASH = 0.015;

const DIMMED = 0.18;
const SPHERE = new SphereGeometry(1, 24, 16);
const BOX = new BoxGeometry(1, 1, 1);

export const LAYERS = {
  signs: "Zeros and directions",
  axes: "Joint axes",
  frames: "Frames",
  workspace: "Workspace",
  cameras: "Cameras",
} as const;
export type Layer = keyof typeof LAYERS;

/** Name of a leg's colour in the style sheet. */
export const legColour = (leg: number): string => `--${legClass(leg + 1).replace("-", "")}`;

type Side = "base" | "platform";
const SAME_POINT = 1e-3; // m, for points that are rounded to a tenth of a millimetre

export const matrix = (T: Configuration["T_base_platform"]): Matrix4 =>
  new Matrix4().set(...(T.flat() as Parameters<Matrix4["set"]>));

/** Shapes of one leg. */
class LegModel {
  readonly group = new Group();
  readonly signs = new Group();
  private readonly material: MeshStandardMaterial;
  private readonly axis: Rod;
  private readonly tubes: { rod: Rod; start: number; stop: number }[];
  private readonly arm: Rod[];
  private readonly bar: Rod[];
  private readonly joints: Mesh[];
  private readonly carriage: Mesh | null;
  private readonly arrow: Arrow;
  private readonly zero: Lines;
  private readonly zeroMark: Mesh;
  private readonly guide: Vector3 | null;

  constructor(
    private readonly leg: Leg,
    index: number,
    home: Configuration["legs"][number],
    extent: number,
    palette: Palette,
  ) {
    const colour = legColour(index);
    const paint = (name: string, roughness = 0.55): MeshStandardMaterial =>
      palette.paint(new MeshStandardMaterial({ roughness, metalness: 0.05 }), name);
    this.material = paint(colour);
    const metal = paint("--metal");
    const rod = (material: MeshStandardMaterial, radius: number): Rod => {
      const one = new Rod(material, radius);
      one.mesh.userData.leg = index;
      this.group.add(one.mesh);
      return one;
    };

    const radii = leg.tubes.map((tube) => tube.radius);
    const thin = radii.length ? 0.5 * Math.min(...radii) : ROD * extent;
    this.axis = rod(radii.length ? metal : this.material, thin);
    this.tubes = leg.tubes.map(({ radius, start, stop }) => ({
      rod: rod(this.material, radius),
      start,
      stop,
    }));
    this.arm = home.base.slice(1).map(() => rod(this.material, ARM * extent));
    this.bar = home.platform.slice(1).map(() => rod(metal, BAR * extent));
    const sizes = [radii[0], radii.at(-1)].map((r) => Math.max(JOINT * extent, 1.2 * (r ?? 0)));
    this.joints = sizes.map((size) => {
      const mesh = new Mesh(SPHERE, metal);
      mesh.scale.setScalar(size);
      mesh.userData.leg = index;
      this.group.add(mesh);
      return mesh;
    });

    // a guide, or the arc over which an arm turns
    const onGuide = leg.path.length > 0 && home.base.length === 1;
    const ends = leg.path.map(vector);
    this.guide = onGuide ? ends[ends.length - 1].clone().sub(ends[0]).normalize() : null;
    this.carriage = null;
    if (this.guide) {
      const over = this.guide.clone().multiplyScalar((CARRIAGE / 2) * extent);
      const rail = new Rod(metal, RAIL * extent);
      rail.place(ends[0].clone().sub(over), ends[ends.length - 1].clone().add(over));
      this.carriage = new Mesh(BOX, this.material);
      this.carriage.scale.set(0.6, 1, 0.6).multiplyScalar(CARRIAGE * extent);
      this.carriage.quaternion.copy(
        new Quaternion().setFromUnitVectors(new Vector3(0, 1, 0), this.guide),
      );
      this.carriage.userData.leg = index;
      this.group.add(rail.mesh, this.carriage);
    } else if (ends.length) {
      const arc = new Lines(lineMaterial(palette, colour, { width: 1.5, opacity: 0.45 }));
      arc.place([leg.path as Point[]]);
      this.signs.add(arc.object);
    }

    this.arrow = new Arrow(palette, colour, HEAD * extent);
    this.zero = new Lines(lineMaterial(palette, colour, { width: 2, dash: DASH * extent, over: true }));
    this.zeroMark = new Mesh(SPHERE, palette.paint(new MeshBasicMaterial({ depthTest: false }), "--card"));
    this.zeroMark.scale.setScalar(0.6 * JOINT * extent);
    this.zeroMark.renderOrder = 3;
    const rim = new Mesh(SPHERE, palette.paint(new MeshBasicMaterial({ depthTest: false }), colour));
    rim.scale.setScalar(1.5);
    rim.renderOrder = 2; // below the mark
    this.zeroMark.add(rim);
    this.signs.add(this.arrow.group, this.zero.object, this.zeroMark);
  }

  place(shape: Configuration["legs"][number]): void {
    const base = (shape.base as Point[]).map(vector);
    const platform = (shape.platform as Point[]).map(vector);
    const a = base[base.length - 1];
    const b = platform[platform.length - 1];
    const u = b.clone().sub(a);
    const length = u.length();
    if (length > 0) u.divideScalar(length);
    const at = (s: number): Vector3 => a.clone().addScaledVector(u, Math.min(s, length));
    this.axis.place(a, b);
    for (const { rod, start, stop } of this.tubes) rod.place(at(start), at(stop));
    this.arm.forEach((rod, k) => rod.place(base[k], base[k + 1]));
    this.bar.forEach((rod, k) => rod.place(platform[k], platform[k + 1]));
    this.joints[0].position.copy(a);
    this.joints[1].position.copy(b);
    this.carriage?.position.copy(a);

    this.arrow.place(shape.positive as Point[]);
    const zero = shape.zero as Point[];
    this.zeroMark.visible = zero.length > 0;
    if (!zero.length) return;
    const mark = zero[zero.length - 1];
    this.zeroMark.position.set(...mark);
    // a guide's zero may lie beyond its range: the way there is drawn
    const rail = this.leg.path as Point[];
    const near = this.guide && [rail[0], rail[rail.length - 1]].sort((p, q) =>
      vector(p).distanceTo(vector(mark)) - vector(q).distanceTo(vector(mark)))[0];
    const between = near && vector(rail[0]).distanceTo(vector(mark)) + vector(rail[rail.length - 1])
      .distanceTo(vector(mark)) > vector(rail[0]).distanceTo(vector(rail[rail.length - 1])) * 1.001;
    this.zero.place(zero.length > 1 ? [zero] : near && between ? [[mark, near]] : []);
  }

  dim(dimmed: boolean): void {
    this.group.traverse((object) => {
      if (!(object instanceof Mesh)) return;
      const material = object.material as MeshStandardMaterial;
      material.transparent = dimmed;
      material.opacity = dimmed ? DIMMED : 1;
      material.depthWrite = !dimmed;
      material.needsUpdate = true;
    });
    this.signs.visible = !dimmed;
  }
}

/** Plate through a closed polygon with its border, or a bar between two points. */
class Plate {
  readonly group = new Group();
  private readonly bar: Rod;
  private readonly border: Lines;
  private readonly fill: Mesh;

  constructor(colour: string, extent: number, palette: Palette) {
    this.bar = new Rod(palette.paint(new MeshStandardMaterial({ roughness: 0.6 }), "--metal"), BAR * extent);
    this.border = new Lines(lineMaterial(palette, colour, { width: 2.5 }));
    const material = new MeshBasicMaterial({
      transparent: true, opacity: 0.22, side: DoubleSide, depthWrite: false,
    });
    this.fill = new Mesh(new BufferGeometry(), palette.paint(material, colour));
    this.fill.frustumCulled = false;
    this.group.add(this.bar.mesh, this.border.object, this.fill);
  }

  place(outline: Point[]): void {
    const closed = outline.length > 3;
    this.bar.mesh.visible = outline.length === 2;
    if (outline.length === 2) this.bar.place(vector(outline[0]), vector(outline[1]));
    this.border.place(closed ? [outline] : []);
    this.fill.visible = closed;
    if (!closed) return;
    const centre = outline
      .slice(1)
      .reduce((sum, p) => sum.add(vector(p)), new Vector3())
      .divideScalar(outline.length - 1);
    const corners = outline.slice(1).flatMap((p, k) => [...centre.toArray(), ...outline[k], ...p]);
    this.fill.geometry.setAttribute("position", new Float32BufferAttribute(corners, 3));
  }
}

/** Closed polygon with its corners around their centre: an enlarged change may exchange neighbours. */
function ordered(outline: Point[]): Point[] {
  if (outline.length < 4) return outline;
  const corners = outline.slice(1).map(vector);
  const centre = corners.reduce((sum, p) => sum.add(p), new Vector3()).divideScalar(corners.length);
  const arms = corners.map((p) => p.clone().sub(centre));
  const normal = arms.reduce((sum, arm, k) =>
    sum.add(arm.clone().cross(arms[(k + 1) % arms.length])), new Vector3()).normalize();
  const [u, v] = [arms[0], normal.cross(arms[0])];
  const angles = arms.map((arm) => Math.atan2(arm.dot(v), arm.dot(u)));
  const order = corners.map((_p, k) => k).sort((a, b) => angles[a] - angles[b]);
  return [...order, order[0]].map((k) => corners[k].toArray() as Point);
}

/** Corner of a plate; leg : whose first point it is, so that it moves with it. */
interface Corner {
  point: Point;
  leg: number;
}

/** Axes of a frame. */
function frame(length: number, palette: Palette): Group {
  const group = new Group();
  ["--x", "--y", "--z"].forEach((colour, k) => {
    const lines = new Lines(lineMaterial(palette, colour, { width: 3 }));
    const tip: Point = [0, 0, 0];
    tip[k] = length;
    lines.place([[[0, 0, 0], tip]]);
    group.add(lines.object);
  });
  return group;
}

export class MachineModel {
  /** Distance of the ground's lines, m. */
  readonly gridStep: number;
  readonly layers: Record<Layer, Group>;
  /** Largest side of the box around the machine, m. */
  readonly extent: number;
  private readonly legs: LegModel[];
  private readonly platform = new Group();
  private readonly plates: Record<Side, Plate>;
  private readonly corners: Record<Side, Corner[]>;
  private readonly platformAxes: Lines;
  private readonly links: { rods: Rod[]; legs: number[]; side: Side }[] = [];
  private readonly points: Vector3[];
  private configuration: Configuration;
  private highlighted: number[] | null = null;

  constructor(
    private readonly machine: Machine,
    private readonly stage: Stage,
    platformColour = "--platform",
  ) {
    const { palette, scene } = stage;
    const { home } = machine;
    this.configuration = home;
    this.points = this.outlinePoints(home);
    const box = new Box3().setFromPoints(this.points);
    const size = box.getSize(new Vector3());
    this.extent = Math.max(size.x, size.y, size.z, 1e-6);
    const extent = this.extent;

    const make = (): Group => {
      const group = new Group();
      scene.add(group);
      return group;
    };
    this.layers = { signs: make(), axes: make(), frames: make(), workspace: make(), cameras: make() };
    const grid = new Grid(box, palette);
    this.gridStep = grid.step;
    scene.add(grid.object);
    this.plates = {
      base: new Plate("--base", extent, palette),
      platform: new Plate(platformColour, extent, palette),
    };
    this.corners = { base: this.cornersOf("base"), platform: this.cornersOf("platform") };
    this.platform.add(this.plates.platform.group);
    scene.add(this.plates.base.group, this.platform);

    this.legs = machine.legs.map((leg, j) => {
      const model = new LegModel(leg, j, home.legs[j], extent, palette);
      scene.add(model.group);
      this.layers.signs.add(model.signs);
      model.group.traverse((object) => {
        if (object.userData.leg !== undefined) stage.pickable.push(object);
      });
      return model;
    });

    // what legs of one motor, or of one bar of the platform, have between them
    const metal = palette.paint(new MeshStandardMaterial({ roughness: 0.6 }), "--metal");
    const link = (legs: number[], side: Side): void => {
      if (legs.length < 2) return;
      const rods = legs.slice(1).map(() => new Rod(metal, BAR * extent));
      scene.add(...rods.map((rod) => rod.mesh));
      this.links.push({ rods, legs, side });
    };
    machine.readings.forEach((reading) => link(reading.legs, "base"));
    const bodies = new Set(machine.legs.map((leg) => leg.body).filter((body) => body !== null));
    for (const body of bodies) {
      link(machine.legs.flatMap((leg, j) => (leg.body === body ? [j] : [])), "platform");
    }

    this.addAxes();
    this.platformAxes = new Lines(this.axisMaterial());
    const own = frame(0.7 * FRAME * extent, palette);
    this.platform.add(own);
    this.layers.axes.add(this.platformAxes.object);
    this.layers.frames.add(frame(FRAME * extent, palette));
    this.addWorkspace();
    this.addCameras();
    this.show(home);
  }

  show(configuration: Configuration): void {
    this.configuration = configuration;
    this.legs.forEach((leg, j) => leg.place(configuration.legs[j]));
    const T = matrix(configuration.T_base_platform);
    this.platform.matrixAutoUpdate = false;
    this.platform.matrix.copy(T);
    this.plates.base.place(this.outline("base", new Matrix4()));
    this.plates.platform.place(this.outline("platform", T.clone().invert()));
    for (const { rods, legs, side } of this.links) {
      const ends = legs.map((j) => vector((configuration.legs[j][side] as Point[]).at(-1) as Point));
      rods.forEach((rod, k) => rod.place(ends[k], ends[k + 1]));
    }
    this.platformAxes.place(
      this.axisLines("platform").map((line) =>
        line.map((p) => vector(p).applyMatrix4(T).toArray() as Point)),
    );
    this.stage.setLabels(this.labels());
  }

  /** Points that the stage is to show: the machine, and its cameras if they are visible. */
  fitPoints(): Vector3[] {
    const { cameras } = this.machine;
    if (!this.layers.cameras.visible || !cameras.length) return this.points;
    return [...this.points, ...cameras.flatMap((camera) =>
      [camera.position as Point, ...(camera.lines as Point[][]).flat()].map(vector))];
  }

  /** Dim all legs but some; null for none. */
  highlight(legs: number[] | null): void {
    this.highlighted = legs;
    this.legs.forEach((leg, j) => leg.dim(legs !== null && !legs.includes(j)));
    this.stage.setLabels(this.labels());
  }

  setLayer(layer: Layer, visible: boolean): void {
    this.layers[layer].visible = visible;
    if (layer === "frames") {
      this.platform.children.slice(1).forEach((child) => (child.visible = visible));
    }
    this.stage.setLabels(this.labels());
  }

  /** Corners of a plate at home, in the frame of its side. */
  private cornersOf(side: Side): Corner[] {
    const { machine } = this;
    const { legs, T_base_platform } = machine.home;
    const toSide = side === "base" ? new Matrix4() : matrix(T_base_platform).invert();
    const firsts = legs.map((leg, j) => {
      const onGuide = side === "base" && leg.base.length === 1 && machine.legs[j].path.length > 0;
      return onGuide ? null : vector(leg[side][0] as Point).applyMatrix4(toSide);
    });
    const outline = (side === "base" ? machine.base_outline : machine.platform_outline) as Point[];
    return outline.map((point) => ({
      point,
      leg: firsts.findIndex((first) => first !== null && first.distanceTo(vector(point)) < SAME_POINT),
    }));
  }

  /** Outline of a plate in the present configuration. */
  private outline(side: Side, toSide: Matrix4): Point[] {
    return ordered(this.corners[side].map(({ point, leg }) =>
      leg < 0 ? point
        : vector(this.configuration.legs[leg][side][0] as Point).applyMatrix4(toSide).toArray() as Point));
  }

  private outlinePoints(home: Configuration): Vector3[] {
    const T = matrix(home.T_base_platform);
    const lines = [
      ...home.legs.flatMap((leg) => [leg.base, leg.platform, leg.zero, leg.positive]),
      ...this.machine.legs.map((leg) => leg.path),
      this.machine.base_outline,
    ] as Point[][];
    const platform = (this.machine.platform_outline as Point[]).map((p) => vector(p).applyMatrix4(T));
    const points = [...lines.flat().map(vector), ...platform];
    // the tips of both frames
    const size = new Box3().setFromPoints(points).getSize(new Vector3());
    const length = 1.2 * FRAME * Math.max(size.x, size.y, size.z);
    for (const M of [new Matrix4(), T]) {
      for (const k of [0, 1, 2]) points.push(new Vector3().setComponent(k, length).applyMatrix4(M));
    }
    return points;
  }

  private axisMaterial() {
    return lineMaterial(this.stage.palette, "--ink", {
      width: 1.5, dash: DASH * 0.7 * this.extent, over: true,
    });
  }

  private axisLines(side: Side): Point[][] {
    return this.machine.axes
      .filter((axis) => axis.side === side)
      .map(({ point, direction }) =>
        [-1, 1].map((sign) => vector(point as Point)
          .addScaledVector(vector(direction as Point), sign * AXIS * this.extent)
          .toArray() as Point));
  }

  private addAxes(): void {
    const lines = new Lines(this.axisMaterial());
    lines.place(this.axisLines("base"));
    this.layers.axes.add(lines.object);
    // motors of arms
    const metal = this.stage.palette.paint(new MeshStandardMaterial({ roughness: 0.6 }), "--metal");
    for (const { leg, side, point, direction } of this.machine.axes) {
      if (side !== "base" || this.machine.home.legs[leg].base.length < 2) continue;
      const motor = new Rod(metal, MOTOR * this.extent);
      const half = vector(direction as Point).multiplyScalar(MOTOR * this.extent);
      const at = vector(point as Point);
      motor.place(at.clone().sub(half), at.clone().add(half));
      motor.mesh.userData.leg = leg;
      this.stage.pickable.push(motor.mesh);
      this.stage.scene.add(motor.mesh);
    }
  }

  private addWorkspace(): void {
    const geometry = new BufferGeometry();
    const points = (this.machine.workspace as Point[]).flat();
    geometry.setAttribute("position", new Float32BufferAttribute(points, 3));
    const material = new PointsMaterial({
      size: 3, sizeAttenuation: false, transparent: true, opacity: 0.55, depthWrite: false,
    });
    this.layers.workspace.add(new Points(geometry, this.stage.palette.paint(material, "--accent")));
  }

  private addCameras(): void {
    const lines = new Lines(lineMaterial(this.stage.palette, "--accent", { width: 1.5 }));
    lines.place(this.machine.cameras.flatMap((camera) => camera.lines as Point[][]));
    this.layers.cameras.add(lines.object);
  }

  /** Labels of the legs, of the signs of readings, of the frames and the cameras. */
  private labels(): Label[] {
    const { machine, configuration, extent } = this;
    const out: Label[] = machine.legs.map((leg, j) => {
      const { base, platform } = configuration.legs[j];
      const a = vector(base[base.length - 1] as Point);
      const b = vector(platform[platform.length - 1] as Point);
      const at = [0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8, 0.1, 0.9];
      return {
        text: String(leg.number),
        className: `chip ${legClass(j + 1)}`,
        places: at.map((share) => a.clone().lerp(b, share)),
      };
    });
    const add = (text: string, className: string, ...places: Vector3[]): void => {
      out.push({ text, className, places });
    };
    if (this.layers.frames.visible) {
      const T = matrix(configuration.T_base_platform);
      for (const [name, M, length] of [
        ["base", new Matrix4(), FRAME * extent],
        ["platform", T, 0.7 * FRAME * extent],
      ] as const) {
        ["x", "y", "z"].forEach((axis, k) => {
          const tip = new Vector3().setComponent(k, 1.12 * length).applyMatrix4(M);
          add(axis, `axis-name ${axis}`, tip);
        });
        const below = new Vector3(0, 0, -0.25 * length).applyMatrix4(M);
        add(name, "frame-name", below, new Vector3(-0.3 * length, 0, 0).applyMatrix4(M));
      }
    }
    if (this.layers.signs.visible) {
      machine.legs.forEach((_leg, j) => {
        const path = configuration.legs[j].positive as Point[];
        if (path.length < 2 || this.highlighted?.includes(j) === false) return;
        const [before, end] = path.slice(-2).map(vector);
        const ahead = end.clone().sub(before).normalize();
        add("+", `sign ${legClass(j + 1)}`, end.addScaledVector(ahead, 2.6 * HEAD * extent));
        const zero = configuration.legs[j].zero as Point[];
        const at = vector(zero[zero.length - 1]);
        const centre = new Vector3(0, 0, 0.04 * extent);
        add("0", `sign ${legClass(j + 1)}`, at.clone().add(centre), at.sub(centre));
      });
    }
    if (this.layers.cameras.visible) {
      for (const camera of machine.cameras) {
        const places = [vector(camera.position as Point)];
        out.push({ text: camera.name, className: "frame-name", places, atBorder: true });
      }
    }
    return out;
  }
}
