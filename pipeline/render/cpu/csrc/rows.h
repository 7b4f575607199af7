// Copies of rows of arrays: density control takes all parameters and moments in another order.
#pragma once

#include <cstdint>
#include <vector>

namespace splat {

struct RowCopy {
    const char* from;
    char* to;
    int64_t bytes;  // of a row
};

// Row i of each copy becomes row rows[i] (count) of its source, or zeros where zeroed (count),
// which may be null, is set.
void take_rows(const std::vector<RowCopy>& copies, const int64_t* rows, const bool* zeroed,
               int64_t count, int threads);

}  // namespace splat
