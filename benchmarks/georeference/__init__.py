"""World frames from GPS and ground control points that are few, narrow, wrong or incomplete."""
