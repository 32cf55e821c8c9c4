// node read_three.mjs FILE.glb: what three.js's GLTFLoader makes of a result, as JSON on stdout
import { readFileSync } from "node:fs";
import { Vector3 } from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

const bytes = readFileSync(process.argv[2]);
const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const gltf = await new GLTFLoader().parseAsync(buffer, "");
gltf.scene.updateMatrixWorld(true);

const meshes = {};
gltf.scene.traverse((node) => {
  if (!node.isMesh) return;
  const { attributes, index } = node.geometry;
  const color = attributes.color;
  meshes[node.name] = {
    material: node.material.type,
    doubleSided: node.material.side === 2,
    triangles: index.count / 3,
    attributes: Object.keys(attributes).sort(),
    // three.js lower-cases the names of application-specific attributes
    temperature: attributes._temperature ? Array.from(attributes._temperature.array) : null,
    linear: color ? Array.from({ length: color.count }, (_, i) => [color.getX(i), color.getY(i), color.getZ(i)]) : null,
    vertices: Array.from({ length: attributes.position.count }, (_, i) =>
      new Vector3().fromBufferAttribute(attributes.position, i).applyMatrix4(node.matrixWorld).toArray()),
  };
});
console.log(JSON.stringify({ extras: gltf.userData.thermofusion ?? null, meshes }));
