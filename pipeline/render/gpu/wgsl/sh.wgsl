// Spherical harmonics of unit directions (polynomials of Sloan 2013, ordered and signed as in
// 3DGS).
// Loops over bands have this constant length, so that compilers unroll them and keep the basis in
// registers.
const kBands = 16u;

const a0 = 0.28209479177387814;
const a1 = 0.4886025119029199;
const b0 = 1.0925484305920792;
const b2 = 0.31539156525252005;
const b4 = 0.5462742152960396;
const c0 = 0.5900435899266435;
const c1 = 2.890611442640554;
const c2 = 0.4570457994644658;
const c3 = 0.3731763325901154;
const c5 = 1.445305721320277;

fn sh_basis(d: vec3<f32>) -> array<f32, kBands> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    return array<f32, kBands>(
        a0,
        -a1 * y, a1 * z, -a1 * x,
        b0 * x * y, -b0 * y * z, b2 * (2 * zz - xx - yy), -b0 * x * z, b4 * (xx - yy),
        -c0 * y * (3 * xx - yy), c1 * x * y * z, -c2 * y * (4 * zz - xx - yy),
        c3 * z * (2 * zz - 3 * xx - 3 * yy), -c2 * x * (4 * zz - xx - yy), c5 * z * (xx - yy),
        -c0 * x * (xx - 3 * yy),
    );
}

// The derivatives with respect to x, y, z as independent variables.
fn sh_derivatives(d: vec3<f32>) -> array<vec3<f32>, kBands> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    return array<vec3<f32>, kBands>(
        vec3(0.0),
        vec3(0.0, -a1, 0.0), vec3(0.0, 0.0, a1), vec3(-a1, 0.0, 0.0),
        b0 * vec3(y, x, 0.0), -b0 * vec3(0.0, z, y), b2 * vec3(-2 * x, -2 * y, 4 * z),
        -b0 * vec3(z, 0.0, x), 2 * b4 * vec3(x, -y, 0.0),
        -3 * c0 * vec3(2 * x * y, xx - yy, 0.0), c1 * vec3(y * z, x * z, x * y),
        -c2 * vec3(-2 * x * y, 4 * zz - xx - 3 * yy, 8 * y * z),
        3 * c3 * vec3(-2 * x * z, -2 * y * z, 2 * zz - xx - yy),
        -c2 * vec3(4 * zz - 3 * xx - yy, -2 * x * y, 8 * x * z),
        c5 * vec3(2 * x * z, -2 * y * z, xx - yy), -3 * c0 * vec3(xx - yy, -2 * x * y, 0.0),
    );
}

fn sh_count(degree: u32) -> u32 {
    return (degree + 1u) * (degree + 1u);
}
