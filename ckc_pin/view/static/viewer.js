// Meshcat's viewer in a page of this program, and functions that all pages use. Comes first in every page's script.
"use strict";

// `var` makes the viewer reachable from the browser's console, and from the tests, as a property of the window.
var viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));

// The viewer takes the window's height; the controls beside the picture need a part of it.
viewer.set_3d_pane_size = function () {
  const pane = element("meshcat-pane");
  viewer.camera.zoom = Math.min(1, pane.offsetWidth / pane.offsetHeight);  // The camera is placed for a square view.
  MeshCat.Viewer.prototype.set_3d_pane_size.call(viewer, pane.offsetWidth, pane.offsetHeight);
};

function element(id) {
  return document.getElementById(id);
}

function showStatus(text) {
  element("status").textContent = text;
}

// Returns the name of a file to save: the page's title and an ending.
function nameFile(ending) {
  return document.title.replace(/[^\w.-]+/g, "_") + ending;
}

function saveFile(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(function () { URL.revokeObjectURL(link.href); }, 60000);  // after the browser has read it
}
