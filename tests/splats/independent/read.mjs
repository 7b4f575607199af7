// node read.mjs FILE.spz|FILE.glb: what Niantic's library decodes, or what Khronos's validator says.
import fs from 'node:fs';

const data = new Uint8Array(fs.readFileSync(process.argv[2]));
let result;
if (process.argv[2].endsWith('.glb')) {
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
