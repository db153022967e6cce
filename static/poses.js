// Poses as position and quaternion (w, x, y, z): moved and turned in the camera's own frame.

/** The product of two quaternions. */
export function times([a, b, c, d], [e, f, g, h]) {
  return [a * e - b * f - c * g - d * h, a * f + b * e + c * h - d * g, a * g - b * h + c * e + d * f, a * h + b * g - c * f + d * e];
}

/** A vector turned by a quaternion. */
export function turned(q, [x, y, z]) {
  const [w, a, b, c] = q;
  const [, i, j, k] = times(times(q, [0, x, y, z]), [w, -a, -b, -c]);
  return [i, j, k];
}

/** The pose moved by a vector and turned by degrees about one axis, both in the camera's frame. */
export function nudged({ position, quaternion_wxyz: q }, move, axis = 0, degrees = 0) {
  const [dx, dy, dz] = turned(q, move);
  const half = (degrees * Math.PI) / 360;
  const turn = [Math.cos(half), 0, 0, 0];
  turn[1 + axis] = Math.sin(half);
  return { position: [position[0] + dx, position[1] + dy, position[2] + dz], quaternion_wxyz: times(q, turn) };
}
