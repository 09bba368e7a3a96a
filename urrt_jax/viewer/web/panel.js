// The panel beside the view: what is told about the registration. Text goes in as text, never as HTML.

const SVG = "http://www.w3.org/2000/svg";

/** The element with this id. */
function at(id) {
  return document.getElementById(id);
}

/** A new element with this text and class. */
function make(name, text = "", className = "") {
  const element = document.createElement(name);
  element.textContent = text;
  if (className) element.className = className;
  return element;
}

/** Writes what no control changes: title, counts, verdict and diagnostics. */
function tell() {
  const { source, target, diagnostics, poses } = content;
  document.title = content.title;
  at("title").textContent = content.title;
  at("counts").textContent = `${count(source.count)} points onto ${count(target.count)} points`;
  const notes = [];
  for (const [name, cloud] of Object.entries({ source, target })) {
    if (cloud.shown < cloud.count) notes.push(`Of the ${name}, ${count(cloud.shown)} points are shown.`);
  }
  if (content.closer) notes.push("The source starts farther away than it is drawn.");
  if (!poses[0].end) notes.push("The pose is not finite, so the source stays where it is.");
  at("notes").textContent = notes.join(" ");

  at("verdict").className = diagnostics.converged ? "" : "failed";
  at("verdict").append(make("strong", diagnostics.converged ? "Converged" : "Not converged"));
  if (!diagnostics.converged) at("verdict").append(make("p", `${sentence(diagnostics.reason)}.`));

  const [ofSource, ofTarget] = diagnostics.overlap;
  row("Confidence", diagnostics.confidence, share(diagnostics.confidence), "That the rotation is right within 5°");
  row("Fitness", diagnostics.fitness, share(diagnostics.fitness), "Share of source points near the target");
  row("Overlap of source", ofSource, percent(ofSource), "Share of its points that lie on the target");
  row("Overlap of target", ofTarget, percent(ofTarget), "Share of its points that lie on the source");
  row("RMSE of inliers", null, digits(diagnostics.rmse), "In the clouds’ unit");
  row("Inlier distance", null, digits(diagnostics.inlier_distance), "What counts as near, in the clouds’ unit");
  const deviation = diagnostics.deviation === null ? "unknown" : `±${degrees(diagnostics.deviation)}`;
  row("Rotation’s deviation", null, deviation, "Standard deviation, from noise and sampling alone");
}

function sentence(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

/** One line of the diagnostics; a share in [0, 1] has a bar. */
function row(name, part, text, explanation) {
  const term = make("dt", name);
  term.title = explanation;
  const bar = make("dd");
  if (part !== null) {
    bar.className = "meter";
    bar.append(make("i"));
    bar.firstChild.style.width = `${100 * part}%`;
  }
  at("diagnostics").append(term, bar, make("dd", text));
}

/** Offers the poses; `choose` is called with the number of the one to show. */
function offerPoses(choose) {
  content.poses.forEach((pose, number) => {
    const label = make("label");
    const input = make("input");
    Object.assign(input, { type: "radio", name: "pose", value: number, checked: number === 0 });
    input.addEventListener("change", () => choose(number));
    const name = number === 0 ? "Result" : `Turned from it by ${degrees(pose.turned)}`;
    label.append(input, make("span", name), make("span", percent(pose.weight)));
    at("poses").append(label);
  });
  at("poses").hidden = content.poses.length < 2;
  at("poses").append(at("poses").querySelector(".note")); // the last
}

/** Writes the matrix of a pose, and by how much it turns. */
function tellMatrix(pose) {
  const rows = [0, 4, 8, 12].map((start) => pose.matrix.slice(start, start + 4));
  at("matrix").tBodies[0].replaceChildren(
    ...rows.map((values, number) => {
      const line = make("tr");
      values.forEach((value, column) => {
        line.append(make("td", number < 3 && column < 3 ? cosine(value) : digits(value, 5)));
      });
      return line;
    }),
  );
  at("angle").textContent = pose.end ? `turns by ${degrees(pose.angle)}` : "";
}

/** Copies the matrix of a pose with all its digits, as JSON and Python read it. */
async function copyMatrix(pose) {
  const rows = [0, 4, 8, 12].map((start) => `[${pose.matrix.slice(start, start + 4).join(", ")}]`);
  const text = `[${rows.join(",\n ")}]`;
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    // Within a notebook's frame the clipboard may be out of reach; what is selected can still be copied.
    const area = make("textarea", text);
    document.body.append(area);
    area.select();
    document.execCommand("copy");
    area.remove();
  }
  at("copy").textContent = "Copied";
  setTimeout(() => (at("copy").textContent = "Copy"), 1200);
}

/** Draws the colour bar of a pose's residuals and how many points have which. */
function tellResiduals(pose, residuals) {
  const stops = content.colors.distances.map(css);
  at("bar").style.background = `linear-gradient(to right, ${stops.join(", ")})`;
  const counts = new Uint32Array(64);
  for (const value of residuals) counts[value >> 2]++;
  // The last column holds all that is farther away as well, and would dwarf the others.
  const most = Math.max(...counts.subarray(0, 63), 1);
  const columns = Array.from(counts, (number, index) => {
    const column = document.createElementNS(SVG, "rect");
    const height = 40 * Math.min(number / most, 1);
    const size = { x: 4 * index + 0.5, y: 40 - height, width: 3, height };
    for (const [name, value] of Object.entries(size)) column.setAttribute(name, value);
    return column;
  });
  at("residuals").querySelector("svg").replaceChildren(...columns);
  const [low, middle, high] = at("ticks").children;
  low.textContent = "0";
  const threshold = content.diagnostics.inlier_distance;
  middle.textContent = threshold ? `inliers ≤ ${digits(threshold)}` : digits(pose.largest / 2);
  high.textContent = (threshold ? "≥ " : "") + digits(pose.largest);
}

/** Draws the three axes as the camera sees them. */
function drawAxes(camera) {
  const turn = camera.quaternion.clone().invert();
  const axes = ["x", "y", "z"].map((name, index) => {
    const direction = new THREE.Vector3().setComponent(index, 1).applyQuaternion(turn);
    return { name, direction };
  });
  axes.sort((one, other) => one.direction.z - other.direction.z); // the nearest last
  at("axes").replaceChildren(
    ...axes.flatMap(({ name, direction }) => {
      const line = document.createElementNS(SVG, "line");
      const text = document.createElementNS(SVG, "text");
      line.setAttribute("x2", 24 * direction.x);
      line.setAttribute("y2", -24 * direction.y);
      text.setAttribute("x", 32 * direction.x);
      text.setAttribute("y", -32 * direction.y);
      text.textContent = name;
      return [line, text];
    }),
  );
}

/** Draws a bar of a round length, in the clouds' unit, at the depth that the camera turns about. */
function drawScale(pixel) {
  const [text, bar] = at("scale").children;
  const longest = 110 * pixel;
  const power = 10 ** Math.floor(Math.log10(longest));
  const length = [5, 2, 1].map((step) => step * power).find((each) => each <= longest);
  text.textContent = digits(length);
  bar.style.width = `${length / pixel}px`;
}
