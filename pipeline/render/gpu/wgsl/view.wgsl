// A pinhole camera. Pixel centres are at half integers; x right, y down, z forward.
struct View {
    size: vec2<u32>,          // pixels
    tiles: vec2<u32>,         // of kTile x kTile pixels
    gaussians: u32,           // N
    sh_coefficients: u32,     // K: of each Gaussian in memory
    sh_degree: u32,           // of those in use
    flags: u32,               // kAntialias, kClampColorGradient
    focal: vec2<f32>,
    principal: vec2<f32>,
    lowest: vec2<f32>,        // between which the Jacobian clamps x / z and y / z
    highest: vec2<f32>,
    right: vec3<f32>,         // rows of the rotation from the world to the camera
    near: f32,
    down: vec3<f32>,
    unused0: u32,
    forward: vec3<f32>,
    unused: u32,
    centre: vec3<f32>,        // of the camera, in the world
    unused2: u32,
    background: vec3<f32>,
    unused3: u32,
}

const kAntialias = 1u;
const kClampColorGradient = 2u;
