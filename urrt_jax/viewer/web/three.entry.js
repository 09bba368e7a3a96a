// What page's scripts use of three.js; README.md says how this becomes three.min.js.
export {
  BufferAttribute,
  BufferGeometry,
  ColorManagement,
  DepthTexture,
  Matrix4,
  Mesh,
  OrthographicCamera,
  PerspectiveCamera,
  Points,
  Quaternion,
  Scene,
  ShaderMaterial,
  Vector2,
  Vector3,
  WebGLRenderer,
  WebGLRenderTarget,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
