// The array of all parameters but the SH coefficients: sections of N rows, as `GEOMETRY`
// in layout.py.
fn inputs_of(i: u32, n: u32) -> Inputs {
    var in: Inputs;
    in.mean = vec3(geometry[3u * i], geometry[3u * i + 1u], geometry[3u * i + 2u]);
    let scale = 3u * (n + i);
    in.log_scale = vec3(geometry[scale], geometry[scale + 1u], geometry[scale + 2u]);
    let quat = 6u * n + 4u * i;
    in.quat = vec4(geometry[quat], geometry[quat + 1u], geometry[quat + 2u], geometry[quat + 3u]);
    in.opacity_logit = geometry[10u * n + i];
    return in;
}
