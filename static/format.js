// How numbers, times and amounts are written: tabular, a real minus sign, a dash for what is not known.

const DASH = "–";

/** A number with a fixed count of decimals. */
export function fixed(value, digits = 2) {
  if (value === null || value === undefined || !Number.isFinite(value)) return DASH;
  const text = value.toFixed(digits);
  return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "−");
}

/** A number with three digits that count, 31000 as 3.1e4. */
export function significant(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return DASH;
  const size = Math.abs(value);
  if (size >= 1e4 || (size > 0 && size < 1e-3)) return value.toExponential(1).replace("e+", "e").replace("-", "−");
  return fixed(value, size >= 100 ? 0 : size >= 10 ? 1 : 2);
}

/** Seconds from the first event: 14.92 s, above a minute 1:14.92. */
export function clockTime(seconds, digits = 2) {
  if (!Number.isFinite(seconds)) return DASH;
  if (seconds < 60) return `${fixed(seconds, digits)} s`;
  const minutes = Math.floor(seconds / 60);
  return `${minutes}:${(seconds - 60 * minutes).toFixed(digits).padStart(digits ? 3 + digits : 2, "0")}`;
}

/** How long something takes: 0.8 s, 30.0 s, 2 min 05 s. */
export function duration(seconds) {
  if (!Number.isFinite(seconds)) return DASH;
  if (seconds < 60) return `${fixed(seconds, 1)} s`;
  const whole = Math.round(seconds);
  return `${Math.floor(whole / 60)} min ${String(whole % 60).padStart(2, "0")} s`;
}

/** An amount in words: 950, 21.4 k, 8.4 M. */
export function amount(count) {
  if (!Number.isFinite(count)) return DASH;
  if (count >= 1e6) return `${fixed(count / 1e6, count >= 1e8 ? 0 : 1)} M`;
  if (count >= 1e4) return `${fixed(count / 1e3, count >= 1e5 ? 0 : 1)} k`;
  return whole(count);
}

/** An integer with thin spaces between thousands. */
export const whole = (count) => (Number.isFinite(count) ? String(Math.round(count)).replace(/\B(?=(\d{3})+$)/g, "\u202f") : DASH);

/** Events per second in millions. */
export const megaRate = (hz) => `${fixed(hz / 1e6, hz >= 1e7 ? 1 : 2)} Mev/s`;

/** A share (0 to 1) as per cent; never 100 % when something is missing. */
export function percent(share) {
  if (share === null || share === undefined || !Number.isFinite(share)) return DASH;
  const value = share * 100;
  return share >= 1 ? "100 %" : `${fixed(Math.min(value, 99.9), 1)} %`;
}

/** Three numbers side by side. */
export const vector = (values, digits = 3) => (values ? values.map((value) => fixed(value, digits)) : null);
