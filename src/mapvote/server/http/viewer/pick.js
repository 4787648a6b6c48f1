// Which point lies under the pointer, and how far it is from one to the next.

const REACH_PX = 8;

// The nearest visible point to the eye within a few pixels of one: [x, y, z] in map metres, or null.
export function pointAt(cloud, px) {
  const { from, way } = cloud.ray(px), radius = REACH_PX / (cloud.shared.pixels.value / cloud.shared.ratio.value);
  let best = null, nearest = Infinity;
  for (const part of cloud.parts) {
    if (!part.points.visible) continue;
    const [ox, oy, oz] = [part.corner[0] - from[0], part.corner[1] - from[1], part.z0 - from[2]];
    const step = 76.8 / 65535, p = part.packed, [low, high] = cloud.shared.slice.value.toArray();
    for (let i = 0; i < p.length; i += 4) {
      const x = ox + p[i] * step, y = oy + p[i + 1] * step, z = oz + p[i + 2] * part.zStep;
      const along = x * way[0] + y * way[1] + z * way[2];
      if (along <= 0 || along >= nearest) continue;
      const off = x * x + y * y + z * z - along * along;
      if (off > (radius * along) ** 2) continue;
      const above = p[i + 3] / 100 - 10;
      if (above < low || above > high) continue;
      nearest = along;
      best = [from[0] + x, from[1] + y, from[2] + z];
    }
  }
  return best;
}

// Where a ray meets the level z, for clicks that meet no point.
export function levelAt(cloud, px, z) {
  const { from, way } = cloud.ray(px), t = (z - from[2]) / way[2];
  return t > 0 && t < 1e5 ? [from[0] + t * way[0], from[1] + t * way[1], z] : null;
}

export const distance = (a, b) => Math.hypot(...a.map((v, i) => v - b[i]));
