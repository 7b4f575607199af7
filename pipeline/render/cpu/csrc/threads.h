// Threads for loops whose parts do not depend on each other. Not OpenMP's: a training step is some
// twenty loops of a few milliseconds, and a thread of libgomp that waits for the next either sleeps
// or burns its processor. On a virtual machine, waking a sleeper can take longer than the loop:
// with sleeping threads a step on two took as long as on one, with these half as long.
#pragma once

#include <cstdint>

namespace splat {

using RangeBody = void (*)(const void* context, int64_t begin, int64_t end);
void run_ranges(int64_t count, int64_t grain, int threads, RangeBody body, const void* context);

// body(begin, end) for [0, count) in ranges of `grain`, on at most `threads` threads, this one
// included. Who does which range is left to chance.
template <class Body>
void parallel_ranges(int64_t count, int64_t grain, int threads, const Body& body) {
    const auto call = [](const void* context, int64_t begin, int64_t end) {
        (*static_cast<const Body*>(context))(begin, end);
    };
    run_ranges(count, grain, threads, call, &body);
}

// body(i) for i in [0, count).
template <class Body>
void parallel_for(int64_t count, int64_t grain, int threads, const Body& body) {
    parallel_ranges(count, grain, threads, [&body](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; i++) body(i);
    });
}

}  // namespace splat
