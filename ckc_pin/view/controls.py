"""The script of our page: what it adds to meshcat's viewer, above all a player's buttons and keys.

The viewer knows most commands. Ours are "several" in one message, "say", "runs" (what there is to show or hide) and a
speed for the animation. Texts from files only ever become text nodes.
"""

from __future__ import annotations

__all__ = ["BAR", "CONTROLS", "STYLE"]

STYLE = """
body { margin: 0; font: 14px/1.5 system-ui, sans-serif; color: #222; overflow: hidden; }
#meshcat-pane { width: 100vw; height: 100vh; height: 100dvh; overflow: hidden; }
#caption { position: absolute; left: 16px; top: 12px; max-width: calc(100vw - 32px); pointer-events: none; }
#caption h1 { font-size: 17px; margin: 0; }
#caption p { margin: 0; overflow-wrap: anywhere; }
#caption label { pointer-events: auto; cursor: pointer; }
#caption input { margin: 0 6px 0 0; }
#caption .end { color: #A33; }
#said { font-variant-numeric: tabular-nums; }
#bar { position: absolute; left: 0; right: 0; bottom: 0; display: flex; flex-wrap: wrap; gap: 4px 10px;
  align-items: center; padding: 8px 16px; background: rgba(255, 255, 255, 0.85); }
#bar[hidden] { display: none; }
#bar button, #bar select { font: inherit; min-width: 36px; min-height: 32px; border: 1px solid #AAA; background: #FFF;
  border-radius: 4px; color: inherit; }
#bar button[aria-pressed=true] { background: #D6E8F5; border-color: #0072B2; }
#at { flex: 1 1 160px; min-width: 120px; height: 32px; margin: 0; }
#time { font-variant-numeric: tabular-nums; white-space: nowrap; min-width: 8.5em; }
@media (max-width: 700px), (max-height: 420px) {
  .dg { display: none !important; }
  #caption { left: 8px; top: 6px; font-size: 12px; line-height: 1.35; }
  #caption h1 { font-size: 14px; }
  #bar { padding: 4px 8px; gap: 4px 6px; }
}
"""

BAR = """<div id="bar" hidden>
<button id="play" title="play or pause (space)">&#9654;</button>
<input id="at" type="range" min="0" step="any" value="0" aria-label="time"
 title="arrows: a hundredth; with shift: one output instant; home, end">
<span id="time"></span>
<select id="speed" aria-label="speed" title="slower, faster (down, up)"></select>
<button id="loop" title="play again and again (L)" aria-pressed="false">loop</button>
<button id="forces" title="arrows of forces (F)" aria-pressed="true" hidden>forces</button>
<button id="record" title="save as a video (R)" aria-pressed="false">video</button>
</div>"""

CONTROLS = """"use strict";
var viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));
var player = (function () {
  function $(id) { return document.getElementById(id); }
  var animator = viewer.animator, runs = [], forces = [], instants = [], going = false, loop = false, recorder = null;
  var speeds = [0.01, 0.02, 0.05, 0.1, 0.2, 0.25, 0.5, 1, 2, 4, 5, 10, 20, 50];
  function object(path) { return viewer.scene_tree.find(path.split("/").filter(Boolean)).object; }
  function go(time) {
    time = Math.max(0, Math.min(animator.duration, time));
    animator.actions.forEach(function (action) {
      action.enabled = true; action.paused = false;
      action.time = Math.min(time, action.getClip().duration);
    });
    animator.mixer.update(0);
    animator.display_progress(time);
    viewer.set_dirty();
    show();
  }
  function play() {
    if (animator.time >= animator.duration) { go(0); }
    animator.actions.forEach(function (action) {
      if (action.time < action.getClip().duration) { action.paused = false; }
    });
    going = true; animator.play(); show();
  }
  function pause() { going = false; animator.pause(); show(); }
  function toggle() { if (animator.playing) { pause(); } else { play(); } }
  function step(by, fine) {
    if (going) { pause(); }
    if (!fine) { go(animator.time + by * animator.duration / 100); return; }
    var near = 1e-6 * animator.duration, now = animator.time;
    var next = by > 0 ? instants.find(function (t) { return t > now + near; })
      : instants.filter(function (t) { return t < now - near; }).pop();
    go(next === undefined ? (by > 0 ? animator.duration : 0) : next);
  }
  function setSpeed(speed) {
    animator.mixer.timeScale = speed;
    var options = Array.from($("speed").options).map(function (o) { return Number(o.value); });
    if (!options.includes(speed)) {
      var all = Array.from(new Set(speeds.concat([speed]))).sort(function (a, b) { return a - b; });
      $("speed").replaceChildren.apply($("speed"), all.map(function (s) { return new Option(s + " \\u00d7", s); }));
    }
    $("speed").value = String(speed);
    if (animator.folder.__folders["default"]) {
      animator.folder.__folders["default"].__controllers.forEach(function (one) {
        if (one.property === "time") { one.name("time (s)"); }
        if (one.property === "timeScale") { one.name("speed").updateDisplay(); }
      });
    }
  }
  function faster(by) {
    var all = Array.from($("speed").options).map(function (o) { return Number(o.value); });
    var k = all.indexOf(animator.mixer.timeScale) + by;
    if (k >= 0 && k < all.length) { setSpeed(all[k]); }
  }
  function setLoop(on) { loop = on; $("loop").setAttribute("aria-pressed", String(on)); }
  function showRun(k, on) {
    if (!runs[k]) { return; }
    object(runs[k].path).visible = on;
    if (runs[k].box) { runs[k].box.checked = on; }
    viewer.set_dirty();
  }
  function showForces(on) {
    forces.forEach(function (path) { object(path).visible = on; });
    $("forces").setAttribute("aria-pressed", String(on));
    viewer.set_dirty();
  }
  function record() {
    if (recorder) { recorder.stop(); return; }
    var type = ["video/webm;codecs=vp9", "video/webm", "video/mp4"].find(function (one) {
      return window.MediaRecorder && MediaRecorder.isTypeSupported(one);
    });
    if (!type) { say("this browser records no video"); return; }
    var parts = [];
    setLoop(false); pause(); go(0);
    recorder = new MediaRecorder(viewer.renderer.domElement.captureStream(60),
      {mimeType: type, videoBitsPerSecond: 8e6});
    recorder.ondataavailable = function (event) { parts.push(event.data); };
    recorder.onstop = function () {
      var link = document.createElement("a");
      link.href = URL.createObjectURL(new Blob(parts, {type: type}));
      link.download = document.title.replace(/[^\\w.-]+/g, "_") + (type === "video/mp4" ? ".mp4" : ".webm");
      link.click();
      recorder = null; $("record").setAttribute("aria-pressed", "false");
    };
    $("record").setAttribute("aria-pressed", "true");
    recorder.onstart = function () { requestAnimationFrame(play); };  // when it has a first picture
    viewer.set_dirty();
    recorder.start();
  }
  function setRuns(found, arrows) {
    runs = found; forces = arrows;
    var lines = $("caption").querySelectorAll("p:not(#said)");
    runs.forEach(function (run, k) {
      var line = lines[k];
      if (!line) { line = document.createElement("p"); line.textContent = run.label; $("said").before(line); }
      if (runs.length > 1) {
        var label = document.createElement("label"), box = document.createElement("input");
        box.type = "checkbox"; box.checked = true; run.box = box;
        box.title = "show or hide" + (k < 9 ? " (" + (k + 1) + ")" : "");
        box.onchange = function () { showRun(k, box.checked); box.blur(); };
        label.append(box, line.textContent);
        line.replaceChildren(label);
      }
      run.end = line.appendChild(document.createElement("span"));
      run.end.className = "end";
    });
    $("forces").hidden = !forces.length;
  }
  function fit() {  // a motion fits a square: on a page that is higher than wide it is seen from farther
    viewer.camera.zoom = Math.min(1, window.innerWidth / window.innerHeight);
    viewer.camera.updateProjectionMatrix();
    viewer.set_dirty();
  }
  window.addEventListener("resize", fit);
  function loaded(options, first) {
    instants = first;
    fit();
    $("bar").hidden = false;
    $("at").max = animator.duration;
    setSpeed(options.timeScale);
    going = animator.playing;
    show();
  }
  function show() {
    var time = animator.time;
    $("at").value = time;
    $("time").textContent = time.toFixed(2) + " / " + animator.duration.toFixed(2) + " s";
    $("play").textContent = animator.playing ? "\\u23F8\\uFE0E" : "\\u25B6\\uFE0E";
    runs.forEach(function (run) {
      var text = run.said && time >= run.t_end - 1e-6 * Math.max(1, run.t_end) ? " \\u2013 " + run.said : "";
      if (run.end.textContent !== text) { run.end.textContent = text; }
    });
  }
  function tick() {
    requestAnimationFrame(tick);
    if (!going) { return; }
    show();
    if (animator.playing) { return; }
    going = false;
    if (recorder) { setTimeout(function () { if (recorder) { recorder.stop(); } }, 300); }
    else if (loop) { go(0); play(); }
    show();
  }
  var keys = {
    " ": toggle, "k": toggle, "l": function () { setLoop(!loop); }, "r": record,
    "f": function () { if (forces.length) { showForces($("forces").getAttribute("aria-pressed") !== "true"); } },
    "arrowleft": function (e) { step(-1, e.shiftKey); }, "arrowright": function (e) { step(1, e.shiftKey); },
    "arrowup": function () { faster(1); }, "arrowdown": function () { faster(-1); },
    "home": function () { pause(); go(0); }, "end": function () { pause(); go(animator.duration); }
  };
  document.addEventListener("keydown", function (event) {
    var on = event.target, own = on.id === "at" || !/^(INPUT|SELECT|TEXTAREA)$/.test(on.tagName);
    if (event.ctrlKey || event.metaKey || event.altKey || !animator.actions.length || !own) { return; }
    if (event.key === " " && on.tagName === "BUTTON") { return; }
    var key = keys[event.key.toLowerCase()];
    if (/^[1-9]$/.test(event.key) && runs.length > 1) {
      key = function () { var k = Number(event.key) - 1; if (runs[k]) { showRun(k, !object(runs[k].path).visible); } };
    }
    if (!key) { return; }
    event.preventDefault(); event.stopPropagation();
    key(event);
  }, true);
  function button(id, act) { $(id).onclick = function (event) { act(); if (event.detail) { $(id).blur(); } }; }
  button("play", toggle);
  button("loop", function () { setLoop(!loop); });
  button("forces", keys.f);
  button("record", record);
  $("at").oninput = function () { if (going) { pause(); } go(Number($("at").value)); };
  $("speed").onchange = function () { setSpeed(Number($("speed").value)); $("speed").blur(); };
  setTimeout(function () { requestAnimationFrame(tick); });
  return {go: go, play: play, pause: pause, setRuns: setRuns, loaded: loaded};
})();
function say(text) { document.getElementById("said").textContent = text; }
viewer.handle_command = function (command) {
  if (command.type === "several") {
    command.commands.forEach(viewer.handle_command);
    if (viewer.connection) { requestAnimationFrame(function () { viewer.connection.send("shown"); }); }
    return;
  }
  if (command.type === "say") { say(command.text); return; }
  if (command.type === "runs") { player.setRuns(command.runs, command.forces); return; }
  MeshCat.Viewer.prototype.handle_command.call(viewer, command);
  if (command.type === "set_animation") {
    var first = command.animations[0];
    player.loaded(command.options, first ? Array.from(first.clip.tracks[0].times) : []);
  }
};
viewer.gui.__folders["Scene"].close();
viewer.gui.close();
"""
