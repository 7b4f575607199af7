#include "rows.h"

#include <cstring>

#include "threads.h"

namespace splat {
namespace {

// Rows of a range: some dozen microseconds of work.
constexpr int64_t kRowsPerRange = 512;

// Copies of a constant size need no call.
template <int64_t kBytes>
void copy(const RowCopy& c, const int64_t* rows, int64_t begin, int64_t end) {
    const int64_t bytes = kBytes ? kBytes : c.bytes;
    for (int64_t i = begin; i < end; i++)
        std::memcpy(c.to + bytes * i, c.from + bytes * rows[i], size_t(bytes));
}

}  // namespace

void take_rows(const std::vector<RowCopy>& copies, const int64_t* rows, const bool* zeroed,
               int64_t count, int threads) {
    parallel_ranges(count, kRowsPerRange, threads, [&](int64_t begin, int64_t end) {
        for (const RowCopy& c : copies) {
            switch (c.bytes) {
                case 4:
                    copy<4>(c, rows, begin, end);
                    break;
                case 12:
                    copy<12>(c, rows, begin, end);
                    break;
                case 16:
                    copy<16>(c, rows, begin, end);
                    break;
                case 192:
                    copy<192>(c, rows, begin, end);
                    break;
                default:
                    copy<0>(c, rows, begin, end);
            }
            for (int64_t i = begin; zeroed && i < end; i++)
                if (zeroed[i]) std::memset(c.to + c.bytes * i, 0, size_t(c.bytes));
        }
    });
}

}  // namespace splat
