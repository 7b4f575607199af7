// Sums over the threads of a workgroup, in the order of `ordinal`. prefix_subgroups.wgsl replaces
// this file on devices with subgroups. Only integers are added, so results do not depend on it.
struct Lane {
    @builtin(local_invocation_id) place: vec3<u32>,
}

struct Prefix {
    before: vec2<u32>,  // the sum of the threads before this one
    total: vec2<u32>,   // the sum of all threads
}

// Two halves: a step of the sum reads one and writes the other.
var<workgroup> running: array<vec2<u32>, 2u * kThreads>;

// The number of the thread in the order of the sums.
fn ordinal(lane: Lane) -> u32 {
    return lane.place.x;
}

fn prefix(lane: Lane, value: vec2<u32>) -> Prefix {
    let local = lane.place.x;
    var sum = value;
    var half = 0u;
    workgroupBarrier();
    running[local] = sum;
    for (var step = 1u; step < kThreads; step *= 2u) {
        workgroupBarrier();
        if (local >= step) { sum += running[half + local - step]; }
        half = kThreads - half;
        running[half + local] = sum;
    }
    workgroupBarrier();
    return Prefix(sum - value, running[half + kThreads - 1u]);
}
