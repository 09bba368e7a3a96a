// Numbers as people read them; a number that is not finite is null and shown as a dash.

/** The value with so many significant digits. */
function digits(value, precision = 3) {
  if (value === null) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-4 || size >= 1e6)) return value.toExponential(precision - 1).replaceAll("-", "−");
  return String(Number(value.toPrecision(precision))).replace("-", "−");
}

/** A number in [0, 1]. */
function share(value) {
  return value === null ? "–" : value.toFixed(3);
}

/** An entry of a rotation matrix. */
function cosine(value) {
  return value === null ? "–" : value.toFixed(5).replace("-", "−");
}

function percent(value) {
  return value === null ? "–" : `${Math.round(100 * value)} %`;
}

function degrees(value) {
  return value === null ? "–" : `${value < 10 ? value.toFixed(2) : value.toFixed(1)}°`;
}

function count(value) {
  return value.toLocaleString("en-US");
}
