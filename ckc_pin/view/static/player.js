// Controls of a playback page: buttons, keys and captions added to meshcat's viewer.
//
// The viewer understands most drawing commands. This script adds "several" (a list of commands in one message), "say"
// (the status line), "runs" (what can be shown or hidden) and the playback speed of "set_animation". Text that comes
// from a user's files is only ever assigned to text nodes, never parsed as HTML.
var player = (function () {
  const SPEEDS = [0.01, 0.02, 0.05, 0.1, 0.2, 0.25, 0.5, 1, 2, 4, 5, 10, 20, 50];
  const VIDEO_TYPES = ["video/webm;codecs=vp9", "video/webm", "video/mp4"];
  const VIDEO_BITS_PER_SECOND = 8e6;
  const LAST_FRAME_MS = 300;  // how long a recording shows the final pose
  const TIME_TOLERANCE = 1e-6;  // relative; keyframes are rounded to single precision

  // Drawn, because not every system has a font with these letters.
  const PLAY_ICON = "M3 1 L14 8 L3 15 Z";
  const PAUSE_ICON = "M3 1 H6.5 V15 H3 Z M9.5 1 H13 V15 H9.5 Z";

  const animator = viewer.animator;
  let runs = [];  // each with path, label, t_end, outcome, and its checkbox and outcome elements
  let forcePaths = [];
  let outputTimes = [];
  let isPlaying = false;
  let isLooping = false;
  let recorder = null;

  function findObject(path) {
    return viewer.scene_tree.find(path.split("/").filter(Boolean)).object;
  }

  // --- time ---------------------------------------------------------------------------------------------------------

  function seek(time) {
    const clamped = Math.max(0, Math.min(animator.duration, time));
    animator.actions.forEach(function (action) {
      action.enabled = true;
      action.paused = false;
      action.time = Math.min(clamped, action.getClip().duration);
    });
    animator.mixer.update(0);
    animator.display_progress(clamped);
    viewer.set_dirty();
    updateDisplay();
  }

  function play() {
    if (animator.time >= animator.duration) { seek(0); }
    animator.actions.forEach(function (action) {
      if (action.time < action.getClip().duration) { action.paused = false; }
    });
    isPlaying = true;
    animator.play();
    updateDisplay();
  }

  function pause() {
    isPlaying = false;
    animator.pause();
    updateDisplay();
  }

  function togglePlay() {
    if (animator.playing) { pause(); } else { play(); }
  }

  function step(direction, toOutputTime) {
    if (isPlaying) { pause(); }
    const now = animator.time;
    if (!toOutputTime) {
      seek(now + direction * animator.duration / 100);
      return;
    }
    const tolerance = TIME_TOLERANCE * animator.duration;
    if (direction > 0) {
      seek(outputTimes.find((t) => t > now + tolerance) ?? animator.duration);
    } else {
      seek(outputTimes.filter((t) => t < now - tolerance).pop() ?? 0);
    }
  }

  function speedOptions() {
    return Array.from(element("speed").options).map((option) => Number(option.value));
  }

  function setSpeed(speed) {
    animator.mixer.timeScale = speed;
    if (!speedOptions().includes(speed)) {
      const speeds = Array.from(new Set(SPEEDS.concat([speed]))).sort((a, b) => a - b);
      element("speed").replaceChildren(...speeds.map((value) => new Option(value + " \u00d7", value)));
    }
    element("speed").value = String(speed);
    // The viewer creates new controls with every animation; label them with units.
    const folder = animator.folder.__folders["default"];
    if (folder) {
      folder.__controllers.forEach(function (controller) {
        if (controller.property === "time") { controller.name("time (s)"); }
        if (controller.property === "timeScale") { controller.name("speed").updateDisplay(); }
      });
    }
  }

  function changeSpeed(direction) {
    const speeds = speedOptions();
    const index = speeds.indexOf(animator.mixer.timeScale) + direction;
    if (index >= 0 && index < speeds.length) { setSpeed(speeds[index]); }
  }

  function setLoop(on) {
    isLooping = on;
    element("loop").setAttribute("aria-pressed", String(on));
  }

  // --- what is shown ------------------------------------------------------------------------------------------------

  function showRun(index, visible) {
    const run = runs[index];
    if (!run) { return; }
    findObject(run.path).visible = visible;
    if (run.checkbox) { run.checkbox.checked = visible; }
    viewer.set_dirty();
  }

  function toggleRun(index) {
    if (runs[index]) { showRun(index, !findObject(runs[index].path).visible); }
  }

  function showForces(visible) {
    forcePaths.forEach(function (path) { findObject(path).visible = visible; });
    element("forces").setAttribute("aria-pressed", String(visible));
    viewer.set_dirty();
  }

  function toggleForces() {
    if (forcePaths.length) { showForces(element("forces").getAttribute("aria-pressed") !== "true"); }
  }

  function showControls(visible) {
    viewer.gui.domElement.style.display = visible ? "" : "none";
    element("controls").setAttribute("aria-pressed", String(visible));
  }

  function toggleControls() {
    showControls(element("controls").getAttribute("aria-pressed") !== "true");
  }

  function setRuns(newRuns, newForcePaths) {
    runs = newRuns;
    forcePaths = newForcePaths;
    const captionLines = element("caption").querySelectorAll("p:not(#status)");
    runs.forEach(function (run, index) {
      const line = captionLines[index] || addCaptionLine(run.label);
      if (runs.length > 1) { addCheckbox(run, index, line); }
      run.outcomeElement = line.appendChild(document.createElement("span"));
      run.outcomeElement.className = "outcome";
    });
    element("forces").hidden = !forcePaths.length;
  }

  function addCaptionLine(text) {
    const line = document.createElement("p");
    line.textContent = text;
    element("status").before(line);
    return line;
  }

  function addCheckbox(run, index, line) {
    const label = document.createElement("label");
    const checkbox = document.createElement("input");
    checkbox.type = "checkbox";
    checkbox.checked = true;
    checkbox.title = "show or hide" + (index < 9 ? " (" + (index + 1) + ")" : "");
    checkbox.onchange = function () {
      showRun(index, checkbox.checked);
      checkbox.blur();
    };
    run.checkbox = checkbox;
    label.append(checkbox, line.textContent);
    line.replaceChildren(label);
  }

  function startAnimation(options, times) {
    outputTimes = times;
    element("bar").hidden = false;
    viewer.set_3d_pane_size();
    element("time-slider").max = animator.duration;
    setSpeed(options.timeScale);
    isPlaying = animator.playing;
    updateDisplay();
  }

  function updateDisplay() {
    const time = animator.time;
    element("time-slider").value = time;
    element("time").textContent = time.toFixed(2) + " / " + animator.duration.toFixed(2) + " s";
    element("play").setAttribute("aria-label", animator.playing ? "pause" : "play");
    element("play").querySelector("path").setAttribute("d", animator.playing ? PAUSE_ICON : PLAY_ICON);
    runs.forEach(function (run) {
      const hasEnded = time >= run.t_end - TIME_TOLERANCE * Math.max(1, run.t_end);
      const text = run.outcome && hasEnded ? " \u2013 " + run.outcome : "";
      if (run.outcomeElement.textContent !== text) { run.outcomeElement.textContent = text; }
    });
  }

  // Follows the viewer's animation on every frame; the viewer does not tell when it ends.
  function followAnimation() {
    requestAnimationFrame(followAnimation);
    if (!isPlaying) { return; }
    updateDisplay();
    if (animator.playing) { return; }
    isPlaying = false;
    if (recorder) {
      setTimeout(function () { if (recorder) { recorder.stop(); } }, LAST_FRAME_MS);
    } else if (isLooping) {
      seek(0);
      play();
    }
    updateDisplay();
  }

  // --- video --------------------------------------------------------------------------------------------------------

  function toggleRecording() {
    if (recorder) {
      recorder.stop();
      return;
    }
    const type = VIDEO_TYPES.find((name) => window.MediaRecorder && MediaRecorder.isTypeSupported(name));
    if (!type) {
      showStatus("this browser cannot record videos; Firefox and Chromium can");
      return;
    }
    const chunks = [];
    setLoop(false);
    pause();
    seek(0);
    recorder = new MediaRecorder(
      viewer.renderer.domElement.captureStream(60), {mimeType: type, videoBitsPerSecond: VIDEO_BITS_PER_SECOND});
    recorder.ondataavailable = function (event) { chunks.push(event.data); };
    recorder.onstop = function () {
      saveVideo(chunks, type);
      recorder = null;
      element("record").setAttribute("aria-pressed", "false");
    };
    element("record").setAttribute("aria-pressed", "true");
    // Playback starts once the recorder has its first frame, so that the video begins at t = 0.
    recorder.onstart = function () { requestAnimationFrame(play); };
    viewer.set_dirty();
    recorder.start();
  }

  function saveVideo(chunks, type) {
    saveFile(new Blob(chunks, {type: type}), nameFile(type === "video/mp4" ? ".mp4" : ".webm"));
  }

  // --- keys and buttons ---------------------------------------------------------------------------------------------

  const KEY_ACTIONS = {
    " ": togglePlay,
    "k": togglePlay,
    "l": function () { setLoop(!isLooping); },
    "r": toggleRecording,
    "f": toggleForces,
    "h": toggleControls,
    "arrowleft": function (event) { step(-1, event.shiftKey); },
    "arrowright": function (event) { step(1, event.shiftKey); },
    "arrowup": function () { changeSpeed(1); },
    "arrowdown": function () { changeSpeed(-1); },
    "home": function () { pause(); seek(0); },
    "end": function () { pause(); seek(animator.duration); }
  };

  function handleKey(event) {
    const target = event.target;
    const hasModifier = event.ctrlKey || event.metaKey || event.altKey;
    const isTyping = target.id !== "time-slider" && /^(INPUT|SELECT|TEXTAREA)$/.test(target.tagName);
    if (hasModifier || isTyping || !animator.actions.length) { return; }
    if (event.key === " " && target.tagName === "BUTTON") { return; }  // the browser clicks the button
    let action = KEY_ACTIONS[event.key.toLowerCase()];
    if (/^[1-9]$/.test(event.key) && runs.length > 1) {
      action = function () { toggleRun(Number(event.key) - 1); };
    }
    if (!action) { return; }
    event.preventDefault();
    event.stopPropagation();
    action(event);
  }

  function connectButton(id, action) {
    element(id).onclick = function (event) {
      action();
      if (event.detail) { element(id).blur(); }  // After a mouse click the space bar plays again, not the button.
    };
  }

  // Capturing the event comes before the viewer's own keys, which move the camera.
  document.addEventListener("keydown", handleKey, true);
  connectButton("play", togglePlay);
  connectButton("loop", KEY_ACTIONS.l);
  connectButton("forces", toggleForces);
  connectButton("controls", toggleControls);
  connectButton("record", toggleRecording);
  element("time-slider").oninput = function () {
    if (isPlaying) { pause(); }
    seek(Number(element("time-slider").value));
  };
  element("speed").onchange = function () {
    setSpeed(Number(element("speed").value));
    element("speed").blur();
  };
  showControls(false);
  setTimeout(function () { requestAnimationFrame(followAnimation); });
  return {seek: seek, play: play, pause: pause, setRuns: setRuns, startAnimation: startAnimation};
})();

viewer.handle_command = function (command) {
  if (command.type === "several") {
    command.commands.forEach(viewer.handle_command);
    if (viewer.connection) {  // The server sends the next live frame when this one is on the screen.
      requestAnimationFrame(function () { viewer.connection.send("shown"); });
    }
    return;
  }
  if (command.type === "say") { showStatus(command.text); return; }
  if (command.type === "runs") { player.setRuns(command.runs, command.forces); return; }
  MeshCat.Viewer.prototype.handle_command.call(viewer, command);
  if (command.type === "set_animation") {
    const animation = command.animations[0];
    player.startAnimation(command.options, animation ? Array.from(animation.clip.tracks[0].times) : []);
  }
};
viewer.gui.__folders["Scene"].close();
viewer.gui.open();
