// The explorer's page: connects the panel, the picture and the program. The page shows what the program reports and
// keeps no state of its own. ckc_pin/explorer/messages.py describes the messages.
var explorer = (function () {
  const RETRY_MS = 1000;
  const OPEN = 1e-4;  // |phi|, m or rad, of loops that cannot be closed
  const NOTICE_MS = 8000;  // how long a notice is shown that is no error

  const MODES = {free: "torque sliders", hold: "hold targets", scene: "the scene's controller"};
  const NO_FOLDER = "To save files, start the explorer with a folder to save into.";

  const waiting = new Map();  // newest message of each control, sent once per animation frame
  let connection = null;
  let setup = null;
  let pose = null;
  let run = null;
  let asksForText = false;
  let noticeTimer = 0;

  // --- to the program -----------------------------------------------------------------------------------------------

  function flush() {
    const messages = Array.from(waiting.values());
    waiting.clear();
    messages.forEach(write);
  }

  function write(message) {
    if (connection && connection.readyState === WebSocket.OPEN) { connection.send(JSON.stringify(message)); }
  }

  function send(message) {
    flush();
    write(message);
  }

  // Sends the newest message of a control with the next animation frame.
  function sendSoon(control, message) {
    if (!waiting.size) { requestAnimationFrame(flush); }
    waiting.set(control, message);
  }

  function createSlider(Row, type, key, endsGesture) {
    return function (name) {
      return new Row(name, {
        move: function (value) { sendSoon(type + name, {type: type, [key]: name, value: value}); },
        release: function () { if (endsGesture) { send({type: "release"}); } else { flush(); } },
      });
    };
  }

  const createMove = createSlider(SliderRow, "move", "coordinate", true);
  const coordinates = new RowList(element("coordinates"), createMove);
  const dependent = new RowList(element("dependent"), createMove);
  const motors = new RowList(element("motors"), createSlider(SliderRow, "set_motor", "name", false));
  const quantities = new RowList(element("quantities"), (name) => new QuantityRow(name, show));
  const margins = new RowList(element("margins"), (name) => new MarginRow(name));
  const parameters = new ParameterList(
    element("parameters"), element("parameter-search"),
    createSlider(ParameterRow, "set_parameter", "name", false));
  const map = new MapCanvas(element("map"), (values) => send({type: "go_to", values: values}));

  function show(name, on) {
    send({type: "show", quantity: name, on: on});
  }

  // --- connection ---------------------------------------------------------------------------------------------------

  function connect() {
    viewer.connect("ws://" + location.host + location.pathname);
    connection = viewer.connection;
    connection.onopen = function () {
      viewer.delete_path(["world"]);  // The program draws its whole scene for a new connection.
      showConnection("");
    };
    connection.onclose = function () {
      grab.release();
      showConnection("The program has ended, or cannot be reached. Trying again every second.");
      setTimeout(connect, RETRY_MS);
    };
  }

  function showConnection(problem) {
    showStatus(problem);
    element("panel").inert = Boolean(problem);
  }

  viewer.handle_command = function (command) {
    if (command.type === "several") {
      command.commands.forEach(viewer.handle_command);
      grab.drawLine();
      // The server sends the next frame when this one is on the screen.
      requestAnimationFrame(function () { write({type: "frame_shown"}); });
    } else if (command.type === "report") {
      REPORTS[command.path](command.content);
    } else {
      MeshCat.Viewer.prototype.handle_command.call(viewer, command);
    }
  };

  // --- reports ------------------------------------------------------------------------------------------------------

  const REPORTS = {
    setup: showSetup, pose: showPose, branch_list: showBranches, map_image: showMap, run: showRun, text: showText,
    notice: showNotice,
  };

  function showSetup(report) {
    setup = report;
    document.title = report.title;
    setText(element("title"), report.title);
    setText(element("summary"), report.summary);
    element("warnings").replaceChildren(...report.warnings.map((text) => createElement("li", text)));
    coordinates.setInfos(report.coordinates.filter((info) => info.is_independent));
    dependent.setInfos(report.coordinates.filter((info) => !info.is_independent));
    element("dependent-section").hidden = report.coordinates.every((info) => info.is_independent);
    quantities.setNames(report.quantities.map((info) => info.name));
    report.quantities.forEach((info) => quantities.rows.get(info.name).setInfo(info));
    element("show-section").hidden = !report.quantities.length;
    parameters.setInfos(report.parameters);
    element("change-section").hidden = !report.parameters.length;
    element("branches-section").hidden = !report.can_branch;
    element("map-section").hidden = !report.can_map;
    setOptions(element("mode"), report.modes.map((mode) => [MODES[mode] || mode, mode]));
    const formulations = ["reduced", "spf", "dae"].map((name) => [name, name]);
    setOptions(element("formulation"), [["as in the scene: " + report.formulation, ""], ...formulations]);
    element("run-section").hidden = !report.modes.length;
    ["save-scene", "save-parameters", "save-run"].forEach((id) => { element(id).disabled = !report.can_save; });
    setText(element("save-note"), report.can_save ? "" : NO_FOLDER);
    grab.setBodies(report);
    map.setUnits(Object.fromEntries(report.coordinates.map((info) => [info.name, info.unit])));
    showMotors();
    if (pose) { showPose(pose); }
  }

  // Replaces the options of a select element and keeps its value if that is still an option.
  function setOptions(select, options) {
    const value = select.value;
    select.replaceChildren(...options.map(([text, option]) => new Option(text, option)));
    if (options.some((entry) => entry[1] === value)) { select.value = value; }
  }

  function showPose(report) {
    pose = report;
    [coordinates, dependent].forEach(function (list) {
      list.forEach(function (row, name) {
        if (name in report.values) { row.setValue(report.values[name]); }
        row.setNote(name === report.ended ? report.end : "", true);
      });
    });
    setText(element("end"), report.end);
    const size = report.closure.toExponential(1) + " (m, rad).";
    setText(element("closure"), (report.closure < OPEN ? "Loops are closed to " : "Loops are open by ") + size);
    margins.setNames(Object.keys(report.margins));
    margins.forEach((row, name) => row.set(...report.margins[name]));
    quantities.forEach((row, name) => row.setLines(report.quantities[name] || []));
    element("undo").disabled = !report.can_undo;
    element("redo").disabled = !report.can_redo;
    map.setValues(report.values);
  }

  function showBranches(report) {
    element("branches-button").setAttribute("aria-pressed", String(report.branches.length > 0));
    setText(element("branches-note"), report.note);
    element("branches").replaceChildren(...report.branches.map(function (text, index) {
      const button = createElement("button", text + (index === report.current ? " (present)" : ""));
      button.setAttribute("aria-current", String(index === report.current));
      button.onclick = function () { send({type: "select_branch", index: index}); };
      return button;
    }));
  }

  function showMap(report) {
    element("map-button").setAttribute("aria-pressed", String(Boolean(report.image)));
    setText(element("map-note"), report.note);
    map.set(report);
  }

  function showRun(report) {
    run = report;
    const isActive = isRunning();
    element("start").disabled = isActive;
    element("pause").disabled = !isActive;
    setText(element("pause"), report.state === "paused" ? "continue" : "pause");
    element("stop").disabled = !isActive;
    element("time-slider").disabled = report.t_last <= 0;
    element("time-slider").max = report.t_last;
    if (!element("time-slider").matches(":active")) { element("time-slider").value = report.t; }
    const rate = report.state === "running" ? ", " + report.real_time.toFixed(2) + " s per second" : "";
    const last = report.t_last > report.t ? " of " + report.t_last.toFixed(2) : "";
    setText(element("time"), report.state === "none" ? "" : "t = " + report.t.toFixed(2) + last + " s" + rate);
    setText(element("run-message"), report.message);
    showMotors();
  }

  function isRunning() {
    return Boolean(run) && (run.state === "running" || run.state === "paused");
  }

  function showMotors() {
    if (!setup || !run) { return; }
    const infos = {
      free: setup.motors.map((info) => ({...info, lower: -info.limit, upper: info.limit})),
      hold: setup.coordinates.filter((info) => info.is_independent),
    }[isRunning() ? run.mode : ""] || [];
    motors.setInfos(infos);
    motors.forEach(function (row, name) { if (name in run.motors) { row.setValue(run.motors[name]); } });
    setText(element("motors-note"), infos.length ? "" : "Motors have sliders during a run with " +
      "\u201c" + MODES.free + "\u201d or \u201c" + MODES.hold + "\u201d.");
  }

  function showText(report) {
    if (!asksForText) { return; }  // another page has asked
    asksForText = false;
    if (report.file_name) {
      const type = report.file_name.endsWith(".svg") ? "image/svg+xml" : "text/plain";
      saveFile(new Blob([report.text], {type: type}), report.file_name);
      return;
    }
    element("text-box").hidden = false;
    element("text").value = report.text;
    setText(element("text-title"), report.title);
    navigator.clipboard.writeText(report.text).then(
      function () { setText(element("text-title"), report.title + ": copied"); },
      function () { element("text").select(); });  // The browser forbids it in a frame, for example.
  }

  function showNotice(report) {
    clearTimeout(noticeTimer);
    element("notice").classList.toggle("error", report.is_error);
    setText(element("notice-text"), report.text);
    element("notice").hidden = !report.text;
    if (!report.is_error) { noticeTimer = setTimeout(closeNotice, NOTICE_MS); }
  }

  function closeNotice() {
    element("notice").hidden = true;
  }

  // --- controls -----------------------------------------------------------------------------------------------------

  function isPressed(id) {
    return element(id).getAttribute("aria-pressed") === "true";
  }

  function toggleBranches() {
    element("branches-section").open = true;
    send({type: "list_branches", on: !isPressed("branches-button")});
  }

  function toggleMap() {
    element("map-section").open = true;
    send({type: "show_map", on: !isPressed("map-button")});
  }

  function start() {
    const formulation = element("formulation").value;
    send({
      type: "start_run", mode: element("mode").value, speed: Number(element("speed").value),
      rtol: Number(element("rtol").value), ...(formulation && {formulation: formulation}),
    });
  }

  function togglePause() {
    if (isRunning()) { send({type: "pause", on: run.state !== "paused"}); }
  }

  function startOrPause() {
    if (isRunning()) { togglePause(); } else if (setup && setup.modes.length) { start(); }
  }

  function ask(what) {
    asksForText = true;
    send({type: "copy_text", what: what});
  }

  function save(what) {
    if (element("file-name").reportValidity()) { send({type: "save", what: what, name: element("file-name").value}); }
  }

  function savePicture() {
    viewer.render();  // The canvas has its picture only until the end of this task.
    viewer.renderer.domElement.toBlob(function (blob) { saveFile(blob, nameFile(".png")); });
  }

  function setCollapsed(isCollapsed) {
    element("sections").hidden = isCollapsed;
    element("collapse").setAttribute("aria-expanded", String(!isCollapsed));
  }

  const BUTTONS = {
    "undo": function () { send({type: "undo"}); },
    "redo": function () { send({type: "redo"}); },
    "home": function () { send({type: "home"}); },
    "help-button": function () { element("help").showModal(); },
    "collapse": function () { setCollapsed(!element("sections").hidden); },
    "notice-close": closeNotice,
    "branches-button": toggleBranches,
    "map-button": toggleMap,
    "reset-parameters": function () { send({type: "reset_parameters"}); },
    "start": start,
    "pause": togglePause,
    "stop": function () { send({type: "stop_run"}); },
    "copy-q_guess": function () { ask("q_guess"); },
    "copy-python": function () { ask("python"); },
    "picture-svg": function () { ask("svg"); },
    "picture-png": savePicture,
    "save-scene": function () { save("scene"); },
    "save-parameters": function () { save("parameters"); },
    "save-run": function () { save("run"); },
  };

  const KEYS = {
    "h": BUTTONS.home, "b": toggleBranches, "m": toggleMap, " ": startOrPause, "?": BUTTONS["help-button"],
  };

  function toggleQuantity(index) {
    const row = Array.from(quantities.rows.values())[index];
    if (row) { row.checkbox.click(); }
  }

  function handleKey(event) {
    const target = event.target, key = event.key.toLowerCase();
    const isTyping = /^(INPUT|TEXTAREA|SELECT)$/.test(target.tagName) && !/^(range|checkbox)$/.test(target.type);
    if (element("help").open || isTyping || event.altKey) { return; }
    let action = null;
    if (event.ctrlKey || event.metaKey) {
      action = {z: event.shiftKey ? BUTTONS.redo : BUTTONS.undo, y: BUTTONS.redo}[key];
    } else if (key === "escape" && grab.isDragging()) {
      action = grab.release;
    } else if (/^[1-9]$/.test(key)) {
      action = function () { toggleQuantity(Number(key) - 1); };
    } else if (key !== " " || !/^(BUTTON|SUMMARY)$/.test(target.tagName) && target.type !== "checkbox") {
      action = KEYS[key];
    }
    if (!action) { return; }
    event.preventDefault();
    action();
  }

  Object.entries(BUTTONS).forEach(function ([id, action]) { element(id).onclick = action; });
  document.addEventListener("keydown", handleKey);
  element("angle-unit").onchange = function () {
    angleUnit = element("angle-unit").value;
    if (setup) { showSetup(setup); }
  };
  element("time-slider").oninput = function () {
    sendSoon("rewind", {type: "rewind", t: Number(element("time-slider").value)});
  };
  element("map-section").ontoggle = function () { map.draw(); };
  new ResizeObserver(function () {
    viewer.set_3d_pane_size();
    map.draw();
  }).observe(element("view"));

  element("panel").inert = true;
  connect();
  return {send: send, sendSoon: sendSoon};
})();
