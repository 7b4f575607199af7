// A (Gaussian, tile) pair's slot of gradients: sums over the pixels of the tile, with
// v = alpha dL/d(alpha) = dL/d(ln alpha) and (u, w) of Record.
const kV = 0u;
const kVU = 1u;
const kVW = 2u;
const kVUU = 3u;
const kVUW = 4u;
const kVWW = 5u;
const kRed = 6u;
const kGreen = 7u;
const kBlue = 8u;
const kDepth = 9u;
const kMoments = 10u;
