// Parallel loops with independent iterations. OpenMP is not used: a training step has about twenty
// loops of a few milliseconds, and between loops a libgomp thread either sleeps or occupies its
// processor. On a virtual machine, waking a sleeping thread can take longer than the loop.
#pragma once

#include <cstdint>

namespace splat {

using RangeBody = void (*)(const void* context, int64_t begin, int64_t end);
void run_ranges(int64_t count, int64_t grain, int threads, RangeBody body, const void* context);

// Seconds since the start of the process: of all loops on several threads, and of all threads that
// run ranges in them.
struct LoopTime {
    double loops, threads;
};
LoopTime loop_time();

// Calls body(begin, end) for [0, count) in ranges of about `grain`, on at most `threads` threads
// including the caller. The ranges and which thread runs which one are not determined: the last
// ones are smaller, and all are one if another loop occupies the threads.
template <class Body>
void parallel_ranges(int64_t count, int64_t grain, int threads, const Body& body) {
    const auto call = [](const void* context, int64_t begin, int64_t end) {
        (*static_cast<const Body*>(context))(begin, end);
    };
    run_ranges(count, grain, threads, call, &body);
}

// Calls body(i) for i in [0, count).
template <class Body>
void parallel_for(int64_t count, int64_t grain, int threads, const Body& body) {
    parallel_ranges(count, grain, threads, [&body](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; i++) body(i);
    });
}

}  // namespace splat
