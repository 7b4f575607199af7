// Exclusive prefix sums, 1024 numbers per workgroup (`blocks`), and the addition of the sums of the
// workgroups before (`add`). Longer arrays are scanned by levels (sort.py).
#import common

struct Size {
    count: u32,
}

@group(0) @binding(0) var<uniform> size: Size;
@group(0) @binding(1) var<storage, read_write> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;  // of each workgroup

const kEach = 4u;  // numbers per thread
var<workgroup> running: array<u32, kThreads>;

@compute @workgroup_size(kThreads)
fn blocks(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
          @builtin(local_invocation_index) local: u32) {
    let block = group_number(group, groups);
    let first = (block * kThreads + local) * kEach;
    var before: array<u32, kEach>;
    var sum = 0u;
    for (var j = 0u; j < kEach; j++) {
        before[j] = sum;
        if (first + j < size.count) { sum += values[first + j]; }
    }
    running[local] = sum;
    for (var step = 1u; step < kThreads; step *= 2u) {
        workgroupBarrier();
        var left = 0u;
        if (local >= step) { left = running[local - step]; }
        workgroupBarrier();
        running[local] += left;
    }
    let base = running[local] - sum;
    for (var j = 0u; j < kEach; j++) {
        if (first + j < size.count) { values[first + j] = base + before[j]; }
    }
    if (local == kThreads - 1u && block * kThreads * kEach < size.count) {
        sums[block] = running[local];
    }
}

@compute @workgroup_size(kThreads)
fn add(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
       @builtin(local_invocation_index) local: u32) {
    let block = group_number(group, groups);
    let first = (block * kThreads + local) * kEach;
    for (var j = 0u; j < kEach; j++) {
        if (first + j < size.count) { values[first + j] += sums[block]; }
    }
}
