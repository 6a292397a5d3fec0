// Taking hold of a body in the picture: a pointer on a body drags it, a pointer on the background turns the view.
//
// The grabbed point moves in a plane: that of a planar mechanism, otherwise the plane of the screen through the point.
// A second finger ends the drag, and both fingers then shift and zoom the view.
var grab = (function () {
  const {BufferGeometry, Line, LineBasicMaterial, Plane, Points, PointsMaterial, Raycaster, Vector2, Vector3} =
    MeshCat.THREE;
  const POINT_RADIUS = 14;  // px; a named point this close to the pointer is preferred
  const FINGER_RADII = [9, 18];  // px, around a finger that hits no body
  const MIN_PLANE_COSINE = 0.15;  // between the ray and the plane's normal; below it the plane is seen edge-on
  const COLOUR = 0x222222;

  const pane = element("meshcat-pane");
  const raycaster = new Raycaster();
  let bodies = {};  // paths by name
  let points = {};  // [name of the body, x, y, z] by name
  let planarNormal = null;  // in the world
  let drag = null;  // its body, point, plane, normal and last event
  let hoverEvent = null;
  const fingers = new Set();  // pointers that are down
  const line = createLine();

  function createLine() {
    const geometry = new BufferGeometry().setFromPoints([new Vector3(), new Vector3()]);
    const material = {color: COLOUR, depthTest: false, transparent: true};
    const drawn = new Line(geometry, new LineBasicMaterial(material));
    drawn.add(new Points(geometry, new PointsMaterial({...material, size: 7, sizeAttenuation: false})));
    [drawn, ...drawn.children].forEach(function (part) {
      part.frustumCulled = false;
      part.renderOrder = 1000;
    });
    drawn.visible = false;
    viewer.scene.add(drawn);
    return drawn;
  }

  // Returns the object at a path, or undefined. The viewer's own search would create it.
  function findObject(path) {
    let node = viewer.scene_tree;
    for (const name of path.split("/").filter(Boolean)) { node = node && node.children[name]; }
    return node && node.object;
  }

  function world() {
    return viewer.scene_tree.find(["world"]).object;
  }

  function toClip(x, y) {
    const box = viewer.renderer.domElement.getBoundingClientRect();
    return new Vector2(2 * (x - box.left) / box.width - 1, 1 - 2 * (y - box.top) / box.height);
  }

  // Returns where a point of the viewer's scene is in the window, or null if it is behind the camera.
  function toWindow(point) {
    const box = viewer.renderer.domElement.getBoundingClientRect();
    const clip = point.clone().project(viewer.camera);
    if (Math.abs(clip.z) > 1) { return null; }
    return new Vector2(box.left + (clip.x + 1) * box.width / 2, box.top + (1 - clip.y) * box.height / 2);
  }

  function isVisible(object) {
    return !object || (object.visible && isVisible(object.parent));
  }

  // --- picking ------------------------------------------------------------------------------------------------------

  function pickPoint(x, y) {
    let nearest = null, distance = POINT_RADIUS;
    for (const [body, ...position] of Object.values(points)) {
      const object = bodies[body] && findObject(bodies[body]);
      const at = object && toWindow(object.localToWorld(new Vector3(...position)));
      if (at && at.distanceTo(new Vector2(x, y)) <= distance) {
        distance = at.distanceTo(new Vector2(x, y));
        nearest = {body: body, point: new Vector3(...position)};
      }
    }
    return nearest;
  }

  function pickBody(x, y) {
    const names = new Map();
    for (const [name, path] of Object.entries(bodies)) {
      const object = findObject(path);
      if (object) { names.set(object, name); }
    }
    raycaster.setFromCamera(toClip(x, y), viewer.camera);
    const hit = raycaster.intersectObjects(Array.from(names.keys()), true)
      .find((one) => one.object.isMesh && isVisible(one.object));
    if (!hit) { return null; }
    let object = hit.object;
    while (!names.has(object)) { object = object.parent; }
    return {body: names.get(object), point: object.worldToLocal(hit.point)};
  }

  function pick(event) {
    const {clientX: x, clientY: y} = event;
    viewer.scene.updateMatrixWorld(true);
    let found = pickPoint(x, y) || pickBody(x, y);
    if (event.pointerType !== "touch") { return found; }
    for (const radius of FINGER_RADII) {
      for (let k = 0; k < 8 && !found; k += 1) {
        found = pickBody(x + radius * Math.cos(k * Math.PI / 4), y + radius * Math.sin(k * Math.PI / 4));
      }
    }
    return found;
  }

  // --- dragging -----------------------------------------------------------------------------------------------------

  function start(event) {
    fingers.add(event.pointerId);
    if (event.replayed) { return; }
    if (drag) {
      if (event.pointerType === "touch") { handOver(); }
      return;
    }
    const isPlain = event.button === 0 && !(event.ctrlKey || event.shiftKey || event.metaKey);
    const found = isPlain && fingers.size === 1 ? pick(event) : null;
    if (!found) { return; }
    const grabbed = findObject(bodies[found.body]).localToWorld(found.point.clone());
    const at = toWindow(grabbed) || new Vector2(event.clientX, event.clientY);
    const normal = chooseNormal(grabbed);
    drag = {
      ...found, normal: normal, plane: new Plane().setFromNormalAndCoplanarPoint(normal, grabbed), last: event,
      offset: at.sub(new Vector2(event.clientX, event.clientY)), target: grabbed, hasMoved: false,
    };
    viewer.controls.enabled = false;
    pane.setPointerCapture(event.pointerId);
    pane.classList.add("grabs");
    if (document.activeElement) { document.activeElement.blur(); }  // so that keys reach the page
  }

  function chooseNormal(grabbed) {
    const direction = viewer.camera.getWorldDirection(new Vector3());
    if (!planarNormal) { return direction; }
    const normal = planarNormal.clone().transformDirection(world().matrixWorld);
    const ray = grabbed.clone().sub(viewer.camera.getWorldPosition(new Vector3())).normalize();
    return Math.abs(normal.dot(ray)) < MIN_PLANE_COSINE ? direction : normal;
  }

  function move(event) {
    if (!drag) {
      if (!hoverEvent) { requestAnimationFrame(showHover); }
      hoverEvent = event;
      return;
    }
    if (event.pointerId !== drag.last.pointerId) { return; }
    drag.last = event;
    raycaster.setFromCamera(toClip(event.clientX + drag.offset.x, event.clientY + drag.offset.y), viewer.camera);
    const target = raycaster.ray.intersectPlane(drag.plane, new Vector3());
    if (!target) { return; }
    drag.target = target;
    drag.hasMoved = true;
    const toWorld = world().matrixWorld.clone().invert();
    explorer.sendSoon("drag", {
      type: "drag", body: drag.body, point: drag.point.toArray(),
      target: target.clone().applyMatrix4(toWorld).toArray(),
      normal: drag.normal.clone().transformDirection(toWorld).toArray(),
    });
    drawLine();
  }

  function end(event) {
    fingers.delete(event.pointerId);
    if (drag && event.pointerId === drag.last.pointerId) { release(); }
  }

  function release() {
    if (!drag) { return; }
    const {hasMoved, last} = drag;
    drag = null;
    line.visible = false;
    viewer.controls.enabled = true;
    viewer.set_dirty();
    pane.classList.remove("grabs");
    if (pane.hasPointerCapture(last.pointerId)) { pane.releasePointerCapture(last.pointerId); }
    if (hasMoved) { explorer.send({type: "release"}); }
  }

  // Ends the drag and lets the viewer's controls know the first finger; they get the second one by themselves.
  function handOver() {
    const {pointerId, pointerType, isPrimary, clientX, clientY} = drag.last;
    release();
    const replay = new PointerEvent("pointerdown", {
      pointerId: pointerId, pointerType: pointerType, isPrimary: isPrimary, clientX: clientX, clientY: clientY,
    });
    replay.replayed = true;
    pane.dispatchEvent(replay);
  }

  function showHover() {
    const canGrab = hoverEvent.buttons === 0 && hoverEvent.pointerType !== "touch" && Boolean(pick(hoverEvent));
    pane.classList.toggle("can-grab", canGrab);
    hoverEvent = null;
  }

  // Draws the line from the grabbed point, where it is now, to the target.
  function drawLine() {
    const object = drag && findObject(bodies[drag.body]);
    if (!object) { return; }
    viewer.scene.updateMatrixWorld(true);
    const position = line.geometry.attributes.position;  // in the scene's axes; the scene itself is turned
    [object.localToWorld(drag.point.clone()), drag.target.clone()].forEach(function (end, k) {
      position.setXYZ(k, ...line.worldToLocal(end).toArray());
    });
    position.needsUpdate = true;
    line.visible = true;
    viewer.set_dirty();
  }

  // Capturing the event comes before the viewer's controls.
  pane.addEventListener("pointerdown", start, true);
  pane.addEventListener("pointermove", move, true);
  pane.addEventListener("pointerup", end, true);
  pane.addEventListener("pointercancel", end, true);

  return {
    release: release,
    drawLine: drawLine,
    isDragging: function () { return Boolean(drag); },
    setBodies: function (setup) {
      bodies = setup.bodies;
      points = setup.points;
      planarNormal = setup.normal && new Vector3(...setup.normal);
    },
  };
})();
