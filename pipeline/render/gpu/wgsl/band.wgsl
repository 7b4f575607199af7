// A band of rows of tiles. Long dispatches are divided into bands: drivers of displays end those of
// seconds.
struct Band {
    first_row: u32,
    flags: u32,
}
const kPlanes = 1u;  // alpha and depths are written; backward: their gradients are not all zero
