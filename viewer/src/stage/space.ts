/** What a report adds to the machine on the stage: change, ellipsoids, points, arrows and paths. */

import {
  Group,
  InstancedMesh,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  MeshStandardMaterial,
  SphereGeometry,
  Vector3,
} from "three";
import type { Configuration, LegChange, Space, SpaceArrows, SpacePoints } from "../document";
import { MachineModel, legColour, matrix } from "./machine";
import { Lines, type Point, lineMaterial, vector } from "./shapes";
import type { Stage } from "./stage";

const POINT = 0.008; // radii, as shares of the machine's extent
const HEAD_SHARE = 0.25; // of an arrow, of its length
const MARKED = 2; // enlargement of a point that is marked
const BALL = new SphereGeometry(1, 12, 8);
const ELLIPSOID = new SphereGeometry(1, 32, 24);

/** Part of the stage that can be hidden. */
interface Item {
  name: string;
  colour: string;
  visible: boolean;
  show: (visible: boolean) => void;
}

/**
 * What is shown of the block: a pose, the share of the way from the machine before (0) to the one
 * after (1), and the enlargements of changes and of ellipsoids.
 */
export interface SpaceState {
  pose: number;
  share: number;
  enlargement: number;
  ellipsoids: number;
}

/** Configuration with each point moved by a share of its change. */
function displaced(one: Configuration, changes: LegChange[], share: number): Configuration {
  const turn = new Matrix4().extractRotation(matrix(one.T_base_platform));
  const moved = (line: Point[], change: Point[], frame: Matrix4): Point[] =>
    line.map((p, k) =>
      vector(change[k]).multiplyScalar(share).applyMatrix4(frame).add(vector(p)).toArray() as Point);
  return {
    ...one,
    legs: one.legs.map((leg, j) => ({
      ...leg,
      base: moved(leg.base as Point[], changes[j].base as Point[], new Matrix4()),
      platform: moved(leg.platform as Point[], changes[j].platform as Point[], turn),
    })),
  };
}

/** Lines of a machine as a skeleton. */
const skeleton = (one: Configuration): Point[][] =>
  one.legs.map((leg) => [...leg.base, ...[...leg.platform].reverse()] as Point[]);

export class SpaceModel {
  readonly items: Item[] = [];
  readonly model: MachineModel;
  private readonly before: Lines;
  private readonly ellipsoids: { mesh: Mesh; own: Space["ellipsoids"][number] }[];
  private readonly arrows: { lines: Lines; content: SpaceArrows }[] = [];
  private readonly clouds: { mesh: InstancedMesh; content: SpacePoints }[] = [];
  private marked: string | null | undefined;
  private drawn: Configuration["legs"] = [];

  constructor(
    private readonly block: Space,
    private readonly stage: Stage,
  ) {
    const { palette, scene } = stage;
    this.model = new MachineModel(block.machine, stage, "--base");
    const { extent } = this.model;

    this.before = new Lines(lineMaterial(palette, "--drawing", { width: 2, over: true }));
    if (block.changes.length) this.add(block.names[0], "--drawing", true, this.before.object);

    const shells = new Group();
    this.ellipsoids = block.ellipsoids.map((own) => {
      const material = new MeshBasicMaterial({ transparent: true, opacity: 0.5, depthTest: false });
      const mesh = new Mesh(ELLIPSOID, palette.paint(material, legColour(own.leg)));
      mesh.matrixAutoUpdate = false;
      mesh.renderOrder = 3;
      shells.add(mesh);
      return { mesh, own };
    });
    if (block.ellipsoids.length) this.add(`${block.sigmas}σ ellipsoids`, "--muted", true, shells);

    for (const content of block.points) {
      const material = palette.paint(new MeshStandardMaterial({ roughness: 0.7 }), content.colour);
      const mesh = new InstancedMesh(BALL, material, content.points.length);
      mesh.userData.parts = content.points.map((_p, k) => ({ key: content.keys[k], tip: content.tips[k] }));
      mesh.frustumCulled = false;
      stage.pickable.push(mesh);
      this.clouds.push({ mesh, content });
      this.add(content.name, content.colour, content.visible, mesh);
    }
    this.mark(null);

    for (const content of block.arrows) {
      const lines = new Lines(lineMaterial(palette, content.colour, { width: 1.5 }));
      this.add(content.name, content.colour, content.visible, lines.object);
      this.arrows.push({ lines, content });
    }
    for (const path of block.paths) {
      const dash = path.dashed ? 0.02 * extent : 0;
      const lines = new Lines(lineMaterial(palette, path.colour, { width: 2.5, dash }));
      lines.place(path.lines as Point[][]);
      this.add(path.name, path.colour, true, lines.object);
    }
    scene.updateMatrixWorld();
  }

  show({ pose, share, enlargement, ellipsoids }: SpaceState): void {
    const { poses, changes, machine, arrows } = this.block;
    const one = poses[pose]?.configuration ?? machine.home;
    const own = changes.length > 1 ? changes[pose] : changes[0];
    const drawn = own ? displaced(one, own as LegChange[], share * enlargement - 1) : one;
    if (own) this.before.place(skeleton(displaced(one, own as LegChange[], -1)));
    this.model.show(drawn);
    this.drawn = drawn.legs;
    const turn = new Matrix4().extractRotation(matrix(one.T_base_platform));
    for (const { mesh, own: { leg, side, axes } } of this.ellipsoids) {
      const at = vector(drawn.legs[leg][side].at(-1) as Point);
      const [u, v, w] = axes.map((axis) => vector(axis as Point).multiplyScalar(ellipsoids));
      mesh.matrix.makeBasis(u, v, w);
      if (side === "platform") mesh.matrix.premultiply(turn);
      mesh.matrix.setPosition(at);
    }
    if (arrows.length) this.placeArrows(enlargement);
    this.stage.draw();
  }

  /** Enlarge the points with a key. */
  mark(key: string | null): void {
    if (key === this.marked) return;
    this.marked = key;
    const size = POINT * this.model.extent;
    for (const { mesh, content } of this.clouds) {
      content.points.forEach((p, k) => {
        const radius = size * (content.sizes[k] ?? 1) * (key && content.keys[k] === key ? MARKED : 1);
        mesh.setMatrixAt(k, new Matrix4().makeScale(radius, radius, radius).setPosition(...(p as Point)));
      });
      mesh.instanceMatrix.needsUpdate = true;
      mesh.computeBoundingSphere();
    }
    this.stage.draw();
  }

  /** Points of everything that is shown. */
  allPoints(): Vector3[] {
    const { points, machine } = this.block;
    return [
      ...this.machinePoints(),
      ...points.flatMap((one) => one.points as Point[]).map(vector),
      ...machine.cameras.flatMap((camera) =>
        [camera.position as Point, ...(camera.lines as Point[][]).flat()].map(vector)),
    ];
  }

  /** Points of the machine in all its poses, and of its enlarged change, without the cameras. */
  machinePoints(): Vector3[] {
    const { cameras } = this.model.layers;
    const { visible } = cameras;
    cameras.visible = false;
    const own = this.model.fitPoints();
    cameras.visible = visible;
    const legs = [...this.block.poses.flatMap((pose) => pose.configuration.legs), ...this.drawn];
    return [...own, ...legs.flatMap((leg) => [...leg.base, ...leg.platform] as Point[]).map(vector)];
  }

  private placeArrows(enlargement: number): void {
    for (const { lines, content } of this.arrows) {
      lines.place(content.points.flatMap((p, k) => arrow(p as Point, content.vectors[k] as Point, enlargement)));
    }
  }

  private add(name: string, colour: string, visible: boolean, object: Group | Mesh): void {
    const parent = new Group(); // lines hide themselves where they are empty
    parent.add(object);
    parent.visible = visible;
    this.stage.scene.add(parent);
    const item: Item = {
      name, colour, visible,
      show: (visible) => {
        item.visible = parent.visible = visible;
        this.stage.draw();
      },
    };
    this.items.push(item);
  }
}

/** Shaft and two barbs of an enlarged vector. */
function arrow(at: Point, by: Point, enlargement: number): Point[][] {
  const tip = vector(at).addScaledVector(vector(by), enlargement);
  const back = vector(by).multiplyScalar(-HEAD_SHARE * enlargement);
  const side = new Vector3(0, 0, 1).cross(back);
  if (side.lengthSq() < 1e-6 * back.lengthSq() ** 2) side.set(1, 0, 0).cross(back);
  side.setLength(0.5 * back.length());
  const barb = (sign: number): Point => tip.clone().add(back).addScaledVector(side, sign).toArray() as Point;
  const end = tip.toArray() as Point;
  return [[at, end], [barb(1), end, barb(-1)]];
}
