"""World coordinates, all of them by pyproj (extra ``geo``): what a map's metres mean on Earth."""
