// prefix.wgsl with subgroups. WebGPU does not define which threads form a subgroup, or in which
// order: `ordinal` numbers the threads as the sums take them.
struct Lane {
    @builtin(subgroup_id) subgroup: u32,
    @builtin(num_subgroups) subgroups: u32,
}

struct Prefix {
    before: vec2<u32>,  // the sum of the threads before this one
    total: vec2<u32>,   // the sum of all threads
}

var<workgroup> subgroup_sums: array<vec2<u32>, kThreads>;

// The number of the thread in the order of the sums.
fn ordinal(lane: Lane) -> u32 {
    return prefix(lane, vec2(1u, 0u)).before.x;
}

fn prefix(lane: Lane, value: vec2<u32>) -> Prefix {
    let inside = subgroupExclusiveAdd(value);
    let sum = subgroupAdd(value);
    let is_first = subgroupExclusiveAdd(1u) == 0u;
    workgroupBarrier();
    if (is_first) { subgroup_sums[lane.subgroup] = sum; }
    workgroupBarrier();
    var found = Prefix(inside, vec2(0u));
    for (var s = 0u; s < lane.subgroups; s++) {
        if (s == lane.subgroup) { found.before += found.total; }
        found.total += subgroup_sums[s];
    }
    return found;
}
