/** Images of the page in the frusta of the cameras that took them. */

import {
  BufferGeometry,
  CanvasTexture,
  DoubleSide,
  Float32BufferAttribute,
  type Group,
  Mesh,
  MeshBasicMaterial,
  SRGBColorSpace,
} from "three";
import type { CameraShape, Image } from "../document";
import { toBlobUrl } from "../image_data";
import type { Stage } from "./stage";

const WIDTH = 320; // of a texture, px
const CORNERS = [0, 1, 1, 1, 1, 0, 0, 0]; // texture coordinates: from the upper left on, clockwise

export class FrustumImages {
  private readonly planes: { name: string; mesh: Mesh<BufferGeometry, MeshBasicMaterial>; key: string }[];

  /** A plane for each camera whose frustum has four corners. */
  constructor(cameras: CameraShape[], parent: Group, private readonly stage: Stage) {
    this.planes = cameras.filter(({ lines }) => lines.length === 5).map(({ name, lines }) => {
      const geometry = new BufferGeometry();
      const corners = lines.slice(1).flatMap((ray) => ray[1]);
      geometry.setAttribute("position", new Float32BufferAttribute(corners, 3));
      geometry.setAttribute("uv", new Float32BufferAttribute(CORNERS, 2));
      geometry.setIndex([0, 1, 2, 0, 2, 3]);
      const mesh = new Mesh(geometry, new MeshBasicMaterial({ side: DoubleSide, toneMapped: false }));
      mesh.visible = false;
      parent.add(mesh);
      stage.pickable.push(mesh);
      return { name, mesh, key: "" };
    });
  }

  /** Show the image of each camera, by its name; a camera without one has an empty frustum. */
  show(imageOf: (camera: string) => Image | undefined): void {
    for (const plane of this.planes) {
      const image = imageOf(plane.name);
      const key = image?.webp ? image.key : "";
      if (key === plane.key) continue;
      plane.key = key;
      plane.mesh.visible = false;
      plane.mesh.userData.parts = image && [{ key, tip: image.title }];
      this.stage.draw();
      if (!image || !key) continue;
      void texture(image).then((map) => {
        if (plane.key !== key) return map.dispose(); // another pose was chosen meanwhile
        plane.mesh.material.map?.dispose();
        plane.mesh.material.map = map;
        plane.mesh.material.needsUpdate = plane.mesh.visible = true;
        this.stage.draw();
      });
    }
  }
}

async function texture(image: Image): Promise<CanvasTexture> {
  const source = document.createElement("img");
  source.src = toBlobUrl(image.webp);
  await source.decode();
  const canvas = document.createElement("canvas");
  canvas.width = WIDTH;
  canvas.height = Math.round((WIDTH * image.height) / image.width);
  canvas.getContext("2d")?.drawImage(source, 0, 0, canvas.width, canvas.height);
  const map = new CanvasTexture(canvas);
  map.colorSpace = SRGBColorSpace;
  return map;
}
