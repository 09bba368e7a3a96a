// The drawing: two clouds of round points, a camera, and shading by depth. Points go to the graphics card once; the
// motion is the source's model matrix.

const COLOURS = { plain: 0, region: 1, residual: 2 };
const ELEVATION = (24 * Math.PI) / 180;
const AZIMUTH = (-56 * Math.PI) / 180;
const FIELD = 28; // degrees, vertical; a narrow field distorts little
const MARGIN = 1.06;

const POINT_VERTEX = `
  attribute float label;
  attribute float residual;
  uniform float size;
  uniform int colouring;
  uniform vec3 plain;
  uniform vec3 regions[REGIONS];
  uniform vec3 ramp[RAMP];
  varying vec3 colour;

  void main() {
    gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
    gl_PointSize = size;
    colour = plain;
    if (colouring == 1) colour = regions[int(label + 0.5)];
    if (colouring == 2) {
      float place = clamp(residual, 0.0, 1.0) * float(RAMP - 1);
      int below = min(int(place), RAMP - 2);
      colour = mix(ramp[below], ramp[below + 1], place - float(below));
    }
  }`;

const POINT_FRAGMENT = `
  varying vec3 colour;

  void main() {
    float edge = length(gl_PointCoord - 0.5);
    float cover = clamp((0.5 - edge) / abs(dFdx(gl_PointCoord.x)), 0.0, 1.0);  // edges are a pixel soft
    if (cover < 0.05) discard;
    gl_FragColor = vec4(colour, cover);
  }`;

const SHADE_VERTEX = `
  varying vec2 place;

  void main() {
    place = uv;
    gl_Position = vec4(position.xy, 0.0, 1.0);
  }`;

// Eye-dome lighting (Boucheny 2009): what lies behind its surroundings on the screen is darker. It needs no normals.
const SHADE_FRAGMENT = `
  uniform sampler2D picture;
  uniform sampler2D depths;
  uniform vec2 pixel;
  uniform float near;
  uniform float far;
  uniform float strength;
  varying vec2 place;

  float away(vec2 at) {  // log2 of the distance from the eye
    float depth = texture2D(depths, at).x;
    return log2(near * far / (far - depth * (far - near)));
  }

  void main() {
    vec4 colour = texture2D(picture, place);
    if (strength > 0.0 && texture2D(depths, place).x < 1.0) {
      float here = away(place);
      float behind = 0.0;
      for (int index = 0; index < 8; index++) {
        float angle = float(index) * 0.7853982;
        behind += max(0.0, here - away(place + pixel * vec2(cos(angle), sin(angle))));
      }
      colour.rgb *= max(exp(-strength * behind / 8.0), 0.4);
    }
    gl_FragColor = vec4(colour.rgb, 1.0);
  }`;

THREE.ColorManagement.enabled = false; // every colour here is sRGB and stays so

/** The view on a canvas. `changed` is called after every frame. Throws where there is no WebGL 2. */
function makeView(canvas, changed) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false, powerPreference: "high-performance" });
  renderer.autoClear = false;
  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(FIELD, 1, 0.1, 10);
  const source = cloud(content.source, content.colors.source);
  const target = cloud(content.target, content.colors.target);
  source.matrixAutoUpdate = false;
  scene.add(target, source);

  const picture = new THREE.WebGLRenderTarget(1, 1, { samples: 4, depthTexture: new THREE.DepthTexture(1, 1) });
  const shade = new THREE.ShaderMaterial({
    vertexShader: SHADE_VERTEX,
    fragmentShader: SHADE_FRAGMENT,
    depthTest: false,
    depthWrite: false,
    uniforms: {
      picture: { value: picture.texture },
      depths: { value: picture.depthTexture },
      pixel: { value: new THREE.Vector2() },
      near: { value: 0 },
      far: { value: 0 },
      strength: { value: 1 },
    },
  });
  const screen = new THREE.Scene().add(new THREE.Mesh(sheet(), shade));
  const flat = new THREE.OrthographicCamera();

  const view = { camera, shading: true, size: 1, up: "z", radius: 1, distance: 1, center: new THREE.Vector3() };
  let controls;
  let waiting = false;

  /** Draws at the screen's next frame. */
  view.draw = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      frame();
    });
  };

  function frame() {
    const ratio = Math.min(window.devicePixelRatio, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    const [columns, rows] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (columns !== canvas.width || rows !== canvas.height) {
      renderer.setSize(columns, rows, false);
      picture.setSize(columns, rows);
      camera.aspect = columns / rows;
    }
    const distance = camera.position.distanceTo(view.center);
    // On its way the source may leave the sphere about both ends, but not by its own size.
    camera.near = Math.max(distance - 2 * view.radius, view.radius * 0.004);
    camera.far = distance + 2 * view.radius;
    camera.updateProjectionMatrix();

    // Points grow with the window and the zoom, but half as fast: a surface holds together, and details come apart.
    const zoom = view.distance / camera.position.distanceTo(controls.target);
    const grown = Math.sqrt(Math.min(1, Math.min(width, height) / 600) * Math.min(Math.max(zoom, 0.25), 16));
    for (const each of [source, target]) each.material.uniforms.size.value = view.size * grown * ratio;
    renderer.setRenderTarget(picture);
    renderer.setClearColor(getComputedStyle(document.documentElement).getPropertyValue("--paper").trim());
    renderer.clear();
    renderer.render(scene, camera);

    shade.uniforms.pixel.value.set(1.4 * ratio / columns, 1.4 * ratio / rows);
    shade.uniforms.near.value = camera.near;
    shade.uniforms.far.value = camera.far;
    // A step of a hundredth of the clouds' size looks the same whatever their unit and the distance of the eye. Points
    // that are too few to make a surface would only get dark rims.
    const dense = Math.min(1, Math.sqrt((content.source.shown + content.target.shown) / 40000));
    shade.uniforms.strength.value = view.shading ? (6 * dense * distance) / view.radius : 0;
    renderer.setRenderTarget(null);
    renderer.render(screen, flat);
    changed(view);
  }

  /** Shows the source turned by a quaternion about its own centre, and that centre at a place. */
  view.place = (turn, center) => {
    source.matrix.compose(center, turn, new THREE.Vector3(1, 1, 1));
    source.matrixWorldNeedsUpdate = true;
    view.draw();
  };

  view.show = (name, visible) => {
    (name === "source" ? source : target).visible = visible;
    view.draw();
  };

  view.colour = (name, colouring) => {
    (name === "source" ? source : target).material.uniforms.colouring.value = COLOURS[colouring];
    view.draw();
  };

  /** Gives every source point its distance to the target, a byte each. */
  view.setResiduals = (attribute) => {
    source.geometry.setAttribute("residual", attribute);
    view.draw();
  };

  /** Looks from above and the side at everything there is to see: the source where the motion starts and ends. */
  view.reset = (ends) => {
    camera.up.set(0, view.up === "y" ? 1 : 0, view.up === "z" ? 1 : 0);
    const [side, rise] = [Math.cos(ELEVATION), Math.sin(ELEVATION)];
    const [ahead, across] = [side * Math.cos(AZIMUTH), side * Math.sin(AZIMUTH)];
    const towards = view.up === "z" ? new THREE.Vector3(ahead, across, rise) : new THREE.Vector3(ahead, rise, -across);
    const points = sample(target.geometry, new THREE.Matrix4());
    for (const end of ends) points.push(...sample(source.geometry, end));
    camera.aspect = canvas.clientWidth / Math.max(canvas.clientHeight, 1);
    const fitted = fit(points, towards, camera.up, camera.aspect);
    view.center.copy(fitted.center);
    view.radius = fitted.radius;
    view.distance = fitted.distance;
    camera.position.copy(fitted.center).addScaledVector(towards, fitted.distance);
    controls?.dispose();
    // Made anew, because the controls read the camera's upward direction only once.
    controls = new THREE.OrbitControls(camera, canvas);
    controls.target.copy(fitted.center);
    controls.minDistance = fitted.radius * 0.02;
    controls.maxDistance = fitted.radius * 40;
    controls.zoomToCursor = true;
    controls.addEventListener("change", view.draw);
    controls.update();
    view.draw();
  };

  /** Length of a pixel of the page, in the clouds' unit, at the distance of the point that the camera turns about. */
  view.pixel = () => {
    const distance = camera.position.distanceTo(controls.target);
    return (2 * distance * Math.tan((FIELD * Math.PI) / 360)) / Math.max(canvas.clientHeight, 1);
  };

  new ResizeObserver(view.draw).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", view.draw);
  return view;
}

/** One cloud as points; its colours are chosen on the graphics card. */
function cloud(given, plain) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(pointsOf(given), 3));
  geometry.setAttribute("label", new THREE.BufferAttribute(bytes(given.labels), 1));
  geometry.setAttribute("residual", new THREE.BufferAttribute(new Uint8Array(given.shown), 1, true));
  const vectors = (colors) => colors.map((color) => new THREE.Vector3(...color).divideScalar(255));
  const material = new THREE.ShaderMaterial({
    vertexShader: POINT_VERTEX,
    fragmentShader: POINT_FRAGMENT,
    defines: { REGIONS: content.colors.regions.length, RAMP: content.colors.distances.length },
    alphaToCoverage: true,
    uniforms: {
      size: { value: 3 },
      colouring: { value: COLOURS.plain },
      plain: { value: vectors([plain])[0] },
      regions: { value: vectors(content.colors.regions) },
      ramp: { value: vectors(content.colors.distances) },
    },
  });
  const points = new THREE.Points(geometry, material);
  points.frustumCulled = false; // the matrix moves them without telling where they are
  return points;
}

/** A triangle that covers the screen. */
function sheet() {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
  geometry.setAttribute("uv", new THREE.BufferAttribute(new Float32Array([0, 0, 2, 0, 0, 2]), 2));
  return geometry;
}

/** About a thousand of a cloud's points, moved. */
function sample(geometry, matrix) {
  const position = geometry.getAttribute("position");
  const stride = Math.max(1, Math.floor(position.count / 1000));
  const points = [];
  for (let row = 0; row < position.count; row += stride) {
    points.push(new THREE.Vector3().fromBufferAttribute(position, row).applyMatrix4(matrix));
  }
  return points;
}

/** The center and radius of all points, and the distance from which an eye in this direction sees them all. */
function fit(points, towards, up, aspect) {
  if (!points.length) points = [new THREE.Vector3()];
  const right = new THREE.Vector3().crossVectors(up, towards).normalize();
  const above = new THREE.Vector3().crossVectors(towards, right);
  const axes = [right, above, towards];
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (const point of points) {
    axes.forEach((axis, index) => {
      low[index] = Math.min(low[index], point.dot(axis));
      high[index] = Math.max(high[index], point.dot(axis));
    });
  }
  const center = new THREE.Vector3();
  axes.forEach((axis, index) => center.addScaledVector(axis, (low[index] + high[index]) / 2));
  const slope = Math.tan((FIELD * Math.PI) / 360);
  let [radius, distance] = [0, 0];
  for (const point of points) {
    const offset = point.clone().sub(center);
    radius = Math.max(radius, offset.length());
    const span = Math.max(Math.abs(offset.dot(right)) / aspect, Math.abs(offset.dot(above)));
    distance = Math.max(distance, offset.dot(towards) + (MARGIN * span) / slope);
  }
  radius = radius || 1;
  return { center, radius, distance: distance || 4 * radius };
}
