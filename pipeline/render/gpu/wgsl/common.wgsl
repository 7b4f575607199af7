// What all kernels share. The constants (k...) are those of cpu/csrc/constants.h.

const kThreads = 256u;  // of a workgroup

// Number of a thread, or of a workgroup, in a dispatch: one dimension has at most 65535 workgroups.
fn group_number(group: vec3<u32>, groups: vec3<u32>) -> u32 {
    return group.y * groups.x + group.x;
}
fn thread_number(group: vec3<u32>, groups: vec3<u32>, local: u32) -> u32 {
    return group_number(group, groups) * kThreads + local;
}

// By its bits: compilers may assume that floats are finite.
fn finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}
fn finite3(v: vec3<f32>) -> bool {
    return finite(v.x) && finite(v.y) && finite(v.z);
}
