#include "threads.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <mutex>
#include <new>
#include <system_error>
#include <thread>
#if defined(__unix__) || defined(__APPLE__)
#include <pthread.h>
#endif

namespace splat {
namespace {

// Time that a thread polls for work before it sleeps: longer than the serial part of a step.
constexpr auto kWatch = std::chrono::milliseconds(10);
// The last ranges are smaller by this factor, so that threads finish at about the same time. They
// are as many as kLast whole ranges for each thread.
constexpr int64_t kFiner = 4, kLast = 2;
// Number of polls between two yields of the processor. Yielding lets other processes run: two
// training runs share two processors fairly.
constexpr int kLooks = 16;

using Clock = std::chrono::steady_clock;

inline void pause() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    asm volatile("yield");
#endif
}

// A sum of durations, of several threads.
class Sum {
  public:
    void operator+=(Clock::duration more) {
        ticks_.fetch_add(more.count(), std::memory_order_relaxed);
    }
    double seconds() const {
        return std::chrono::duration<double>(Clock::duration(ticks_)).count();
    }

  private:
    std::atomic<Clock::rep> ticks_{0};
};

// Worker threads join the open loop if they are in time; the caller does not wait for those that
// are not, so a thread that wakes slowly does not delay the loop.
class Crew {
  public:
    // A body that throws ends the program: other threads still use the loop's data.
    void run(int64_t count, int64_t grain, int threads, RangeBody body,
             const void* context) noexcept {
        const int64_t ranges = (count + grain - 1) / grain;
        const int helpers = int(std::min<int64_t>({threads, ranges, kMostHelpers + 1})) - 1;
        // One parallel loop at a time: loops of other callers and nested loops run serially.
        if (helpers < 1 || busy_.exchange(true, std::memory_order_acquire)) {
            if (count > 0) body(context, 0, count);
            return;
        }
        const auto start = Clock::now();
        hire(helpers);
        body_ = body, context_ = context, count_ = count, grain_ = grain;
        whole_ = std::max<int64_t>(0, ranges - kLast * (helpers + 1));
        next_.store(0, std::memory_order_relaxed);
        // Next generation, open, no threads inside.
        const uint64_t generation = state_.load(std::memory_order_relaxed) / kGeneration + 1;
        state_.store(generation * kGeneration + kOpen + uint64_t(helpers) * kPlace);
        if (sleepers_.load() > 0) {
            const std::lock_guard<std::mutex> lock(mutex_);
            wake_.notify_all();
        }
        work();
        state_.fetch_and(~kOpen);
        for (int looks = 0; state_.load(std::memory_order_acquire) % kPlace; looks++)
            look_again(looks);
        loops_ += Clock::now() - start;
        busy_.store(false, std::memory_order_release);
    }

    LoopTime time() const { return {loops_.seconds(), inside_.seconds()}; }

  private:
    // state_: | generation | places left: 8 bits | open: 1 bit | threads inside: 15 bits |
    static constexpr uint64_t kOpen = 1 << 15, kPlace = 1 << 16, kGeneration = 1 << 24;
    static constexpr int64_t kMostHelpers = 255;

    static void look_again(int looks) {
        if (looks % kLooks == kLooks - 1)
            std::this_thread::yield();
        else
            pause();
    }

    void hire(int helpers) {
        try {
            for (; hired_ < helpers; hired_++) std::thread([this] { serve(); }).detach();
        } catch (const std::system_error&) {
            // No more threads can be created: continue with the existing ones.
        }
    }

    // Runs ranges until none is left.
    void work() {
        const auto start = Clock::now();
        take_ranges();
        inside_ += Clock::now() - start;
    }
    void take_ranges() {
        const int64_t fine = std::max<int64_t>(1, grain_ / kFiner);
        for (;;) {
            const int64_t number = next_.fetch_add(1, std::memory_order_relaxed);
            const bool whole = number < whole_;
            const int64_t begin =
                whole ? number * grain_ : whole_ * grain_ + (number - whole_) * fine;
            if (begin >= count_) return;
            body_(context_, begin, std::min(begin + (whole ? grain_ : fine), count_));
        }
    }

    // Whether there is an open loop that this thread, whose last one was `done`, has not joined.
    bool open(uint64_t done) const { return can_join(state_.load(), done); }
    static bool can_join(uint64_t state, uint64_t done) {
        return state / kGeneration != done && state & kOpen && state / kPlace % 256;
    }
    bool join(uint64_t& done) {
        uint64_t seen = state_.load();
        while (can_join(seen, done))
            if (state_.compare_exchange_weak(seen, seen + 1 - kPlace)) {
                done = seen / kGeneration;
                return true;
            }
        return false;
    }

    // Polls for a loop to join, for a limited time.
    bool watch(uint64_t& done) {
        const auto since = std::chrono::steady_clock::now();
        for (int looks = 0; !join(done); looks++) {
            look_again(looks);
            if (looks % 256 == 255 && std::chrono::steady_clock::now() - since > kWatch)
                return false;
        }
        return true;
    }

    void serve() {
        uint64_t done = 0;
        for (;;) {
            // A thread that wakes too late for a loop polls for the next one.
            while (!watch(done)) {
                std::unique_lock<std::mutex> lock(mutex_);
                sleepers_++;
                if (!open(done)) wake_.wait(lock);
                sleepers_--;
            }
            work();
            state_.fetch_sub(1, std::memory_order_release);
        }
    }

    std::atomic<uint64_t> state_{0};
    std::atomic<bool> busy_{false};
    std::atomic<int> sleepers_{0};
    std::mutex mutex_;
    std::condition_variable wake_;
    int hired_ = 0;
    Sum loops_, inside_;

    // Of the open loop
    RangeBody body_;
    const void* context_;
    int64_t count_, grain_;
    int64_t whole_;  // number of ranges of `grain_`
    alignas(64) std::atomic<int64_t> next_{0};
};

// Never destroyed: its threads outlive static objects. A forked process has none of them and starts
// its own.
Crew& crew() {
    alignas(Crew) static unsigned char memory[sizeof(Crew)];
    static Crew* const one = [] {
#if defined(__unix__) || defined(__APPLE__)
        pthread_atfork(nullptr, nullptr, [] { new (memory) Crew; });
#endif
        return new (memory) Crew;
    }();
    return *one;
}

}  // namespace

void run_ranges(int64_t count, int64_t grain, int threads, RangeBody body, const void* context) {
    crew().run(count, grain, threads, body, context);
}

LoopTime loop_time() { return crew().time(); }

}  // namespace splat
