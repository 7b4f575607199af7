// Tiles of kTile x kTile pixels, and the test of which a Gaussian overlaps.

// Tiles, inclusive.
struct Box {
    left: u32,
    top: u32,
    right: u32,
    bottom: u32,
}

// Records hold a tile as its column and, from bit kRowBit on, its row: images are less than 2^20
// pixels wide and high.
const kRowBit = 16u;
fn packed(tile: vec2<u32>) -> u32 { return tile.x | (tile.y << kRowBit); }
fn box_of(r: Record) -> Box {
    let mask = (1u << kRowBit) - 1u;
    return Box(r.first_tile & mask, r.first_tile >> kRowBit, r.last_tile & mask,
               r.last_tile >> kRowBit);
}

// Tolerances of the bounding box, pixels, and of the test of a tile, in log2(alpha): neither must
// exclude a Gaussian that the blend kernel would draw.
const kBoxSlack = 0.01;
const kTileSlack = 1e-3;

// Whether the ellipse {alpha >= 1/255} contains a point of the rectangle of the tile's pixel
// centres. u^2 + w^2 is convex: if the rectangle does not contain the centre, its minimum is on an
// edge that faces the centre.
fn overlaps(r: Record, tile: vec2<u32>) -> bool {
    let low = vec2<f32>(tile * kTile) + 0.5 - r.centre;
    let high = low + f32(kTile - 1u);
    let beside = (low > vec2(0.0)) | (high < vec2(0.0));
    if (!beside.x && !beside.y) { return true; }
    let edge = select(high, low, low > vec2(0.0));
    var least = 1e38;
    if (beside.x) {
        let best = -r.uu * r.uw * edge.x / (r.uw * r.uw + r.ww * r.ww);
        least = power(r, vec2(edge.x, clamp(best, low.y, high.y)));
    }
    if (beside.y) {
        let best = -r.uw * edge.y / r.uu;
        least = min(least, power(r, vec2(clamp(best, low.x, high.x), edge.y)));
    }
    return least <= r.log2_opacity - kLog2AlphaMin + kTileSlack;
}

fn power(r: Record, d: vec2<f32>) -> f32 {
    let u = r.uu * d.x + r.uw * d.y;
    let w = r.ww * d.y;
    return u * u + w * w;
}
