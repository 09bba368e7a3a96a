// What the page was given: numbers, and arrays in base64.

const content = JSON.parse(document.getElementById("content").textContent);

/** The bytes of a base64 text. */
function bytes(text) {
  const characters = atob(text);
  const values = new Uint8Array(characters.length);
  for (let index = 0; index < values.length; index++) values[index] = characters.charCodeAt(index);
  return values;
}

/** The points (N × 3) of a cloud. */
function pointsOf(cloud) {
  return new Float32Array(bytes(cloud.points).buffer);
}

/** Whether a cloud has more than one region. */
function hasRegions(labels) {
  return labels.some((label) => label !== labels[0]);
}

/** A colour as CSS writes it. */
function css([red, green, blue]) {
  return `rgb(${red}, ${green}, ${blue})`;
}
