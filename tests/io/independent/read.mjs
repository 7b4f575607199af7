// node read.mjs FILE.spz: what Niantic's library decodes. node read.mjs validate|attributes FILE.glb:
// what Khronos's validator says, or a primitive's attributes as glTF Transform reads them.
import fs from 'node:fs';

const task = process.argv.at(-2);
const data = new Uint8Array(fs.readFileSync(process.argv.at(-1)));
let result;
if (task === 'attributes') {
    const { Logger, WebIO } = await import('@gltf-transform/core');
    const io = new WebIO().setLogger(new Logger(Logger.Verbosity.SILENT));
    const document = await io.readBinary(data);
    const primitive = document.getRoot().listMeshes()[0].listPrimitives()[0];
    result = { MODE: primitive.getMode() };
    for (const name of primitive.listSemantics())
        result[name] = Array.from(primitive.getAttribute(name).getArray());
} else if (task === 'validate') {
    const { default: validator } = await import('gltf-validator');
    result = await validator.validateBytes(data, { maxIssues: 1000 });
} else {
    const { default: createModule } = await import('@adobe/spz');
    const spz = await createModule({ print: () => {} });
    const cloud = spz.loadSpzFromBuffer(data, { to: spz.CoordinateSystem.UNSPECIFIED });
    result = { antialiased: cloud.antialiased, shDegree: cloud.shDegree };
    for (const name of ['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh'])
        result[name] = Array.from(cloud[name]);
}
fs.writeSync(1, JSON.stringify(result));
