// What happens when something is clicked, moved or pressed.

const MOTION = 1600; // milliseconds from before to after
const PLAY = "M4 2.5v11l9-5.5z";
const PAUSE = "M3.5 2.5h3v11h-3zM9.5 2.5h3v11h-3z";

const labels = { source: bytes(content.source.labels), target: bytes(content.target.labels) };
const start = new THREE.Vector3(...content.start);
const still = new THREE.Quaternion();
const poses = content.poses.map((pose) => {
  if (!pose.end) return { end: start, turn: still };
  const m = pose.matrix;
  const rotation = new THREE.Matrix4().set(m[0], m[1], m[2], 0, m[4], m[5], m[6], 0, m[8], m[9], m[10], 0, 0, 0, 0, 1);
  return { end: new THREE.Vector3(...pose.end), turn: new THREE.Quaternion().setFromRotationMatrix(rotation) };
});
const residuals = content.poses.map((pose) => {
  return new THREE.BufferAttribute(pose.distances ? bytes(pose.distances) : new Uint8Array(content.source.shown), 1, true);
});

let chosen = 0; // the pose shown
let playing = 0; // the request of the next frame of the motion
let view;

tell();
offerPoses(choosePose);
try {
  view = makeView(at("canvas"), ({ camera }) => {
    drawAxes(camera);
    drawScale(view.pixel());
    document.documentElement.dataset.drawn = "yes";
  });
} catch (error) {
  at("obstacle").hidden = false;
  at("obstacle").textContent = `The clouds need WebGL 2, which this browser does not offer. (${error.message})`;
}

for (const name of ["source", "target"]) {
  at(name).parentElement.querySelector("i").style.background = css(content.colors[name]);
  option(`${name}-colour`, "region").disabled = !hasRegions(labels[name]);
}
option("source-colour", "residual").disabled = !content.poses[0].distances;
at("along").disabled = at("play").disabled = !content.poses[0].end;
// Few points are drawn larger, so that they make a surface.
at("size").value = Math.min(Math.max(240 / Math.sqrt(Math.max(content.source.shown, content.target.shown)), 2.5), 6);
setPlaying(false);
choosePose(0);
if (view) {
  view.size = Number(at("size").value);
  listen();
  reset();
}

/** The radio button of a group with this value. */
function option(group, value) {
  return document.querySelector(`input[name="${group}"][value="${value}"]`);
}

function choosePose(number) {
  chosen = number;
  const pose = content.poses[number];
  at("poses").querySelector(".note").hidden = number === 0;
  tellMatrix(pose);
  if (pose.distances) tellResiduals(pose, residuals[number].array);
  view?.setResiduals(residuals[number]);
  place();
}

/** Puts the source where the slider is: turned about its own centre, which moves along a straight line. */
function place() {
  const share = Number(at("along").value);
  const { end, turn } = poses[chosen];
  view?.place(still.clone().slerp(turn, share), start.clone().lerp(end, share));
}

function reset() {
  const whole = new THREE.Vector3(1, 1, 1);
  const ends = poses.map(({ end, turn }) => new THREE.Matrix4().compose(end, turn, whole));
  view.reset([new THREE.Matrix4().setPosition(start), ...ends]);
}

function setPlaying(now) {
  if (!now) cancelAnimationFrame(playing);
  if (!now) playing = 0;
  at("play").querySelector("path").setAttribute("d", now ? PAUSE : PLAY);
  at("play").setAttribute("aria-label", now ? "Pause" : "Play");
}

/** Moves to the other end, from after to before or else to after; pauses if it is moving. */
function play() {
  if (at("along").disabled) return;
  if (playing) return setPlaying(false);
  const from = Number(at("along").value);
  const to = from < 1 ? 1 : 0;
  const duration = matchMedia("(prefers-reduced-motion: reduce)").matches ? 1 : MOTION * Math.abs(to - from);
  const begin = performance.now();
  const step = (now) => {
    const time = Math.min(Math.max((now - begin) / duration, 0), 1);
    const eased = time * time * (3 - 2 * time);
    at("along").value = from + (to - from) * eased;
    place();
    if (time < 1) playing = requestAnimationFrame(step);
    else setPlaying(false);
  };
  setPlaying(true);
  playing = requestAnimationFrame(step);
}

function colour(name) {
  const colouring = document.querySelector(`input[name="${name}-colour"]:checked`).value;
  view.colour(name, colouring);
  if (name === "source") at("residuals").hidden = colouring !== "residual";
}

function listen() {
  for (const name of ["source", "target"]) {
    at(name).addEventListener("change", () => view.show(name, at(name).checked));
    for (const input of document.querySelectorAll(`input[name="${name}-colour"]`)) {
      input.addEventListener("change", () => colour(name));
    }
  }
  at("along").addEventListener("input", () => {
    setPlaying(false);
    place();
  });
  at("size").addEventListener("input", () => {
    view.size = Number(at("size").value);
    view.draw();
  });
  at("shading").addEventListener("change", () => {
    view.shading = at("shading").checked;
    view.draw();
  });
  for (const input of document.querySelectorAll('input[name="up"]')) {
    input.addEventListener("change", () => {
      view.up = input.value;
      reset();
    });
  }
  at("play").addEventListener("click", play);
  at("reset").addEventListener("click", reset);
  at("copy").addEventListener("click", () => copyMatrix(content.poses[chosen]));
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const inside = event.target;
    // What has the focus may use these keys itself.
    if (inside.matches("input") && event.key.startsWith("Arrow")) return;
    if (inside.matches("input:not([type=range]), button, summary") && event.key === " ") return;
    const action = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();
    action();
  });
}

const KEYS = {
  " ": play,
  ArrowLeft: () => nudge("along", -0.02),
  ArrowRight: () => nudge("along", 0.02),
  "+": () => nudge("size", 0.5),
  "=": () => nudge("size", 0.5),
  "-": () => nudge("size", -0.5),
  s: () => at("source").click(),
  t: () => at("target").click(),
  d: () => at("shading").click(),
  c: () => next("source-colour"),
  u: () => next("up"),
  p: () => next("pose"),
  r: reset,
};

/** Moves a slider. */
function nudge(id, by) {
  const slider = at(id);
  if (slider.disabled) return;
  slider.value = Number(slider.value) + by;
  slider.dispatchEvent(new Event("input"));
}

/** Chooses the next of a group's options that can be chosen. */
function next(group) {
  const inputs = [...document.querySelectorAll(`input[name="${group}"]:enabled`)];
  const index = inputs.findIndex((input) => input.checked);
  inputs[(index + 1) % inputs.length].click();
}
