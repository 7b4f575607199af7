// node read.mjs spz FILE...: what Niantic's library decodes, in the axes of PLY files. node read.mjs validate|attributes FILE.glb:
// what Khronos's validator says, or a primitive's attributes as glTF Transform reads them.
import fs from 'node:fs';

const [task, ...files] = process.argv.slice(2);
const [data, ...more] = files.map(file => new Uint8Array(fs.readFileSync(file)));
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
    result = [data, ...more].map(bytes => {
        const cloud = spz.loadSpzFromBuffer(bytes, { to: spz.CoordinateSystem.RDF });
        const found = { antialiased: cloud.antialiased, shDegree: cloud.shDegree };
        for (const name of ['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh'])
            found[name] = Array.from(cloud[name]);
        return found;
    });
}
fs.writeSync(1, JSON.stringify(result));
