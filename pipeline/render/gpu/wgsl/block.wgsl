// Blocks of consecutive elements, one for each workgroup; a thread takes kEach of them.
const kEach = 8u;
const kBlock = kEach * kThreads;

fn blocks_of(elements: u32) -> u32 {
    return (elements + kBlock - 1u) / kBlock;
}
