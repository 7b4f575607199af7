// The common part of all kernels. The constants (k...) are those of cpu/csrc/constants.h.

const kThreads = 256u;  // of a workgroup

// The place of a thread in a dispatch, of which one dimension has at most 65535 workgroups.
struct Thread {
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
}
fn group_of(thread: Thread) -> u32 {
    return thread.group.y * thread.groups.x + thread.group.x;
}
fn number_of(thread: Thread) -> u32 {
    return group_of(thread) * kThreads + thread.local;
}

// By its bits: compilers may assume that floats are finite.
fn finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}
fn finite3(v: vec3<f32>) -> bool {
    return finite(v.x) && finite(v.y) && finite(v.z);
}
