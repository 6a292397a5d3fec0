// Start of a page that is a file: the scene is in the page. Runs after player.js in the same script.
//
// The scene is compressed. Arrays that occur several times are stored once, in a table that `restoreArrays` looks up.
const packedScene = Uint8Array.from(
  atob(document.getElementById("scene").textContent), (letter) => letter.charCodeAt(0));

function restoreArrays(value, arrays) {
  if (value === null || typeof value !== "object" || ArrayBuffer.isView(value)) { return value; }
  if (typeof value.shared === "number") { return arrays[value.shared]; }
  for (const key of Object.keys(value)) { value[key] = restoreArrays(value[key], arrays); }
  return value;
}

function drawScene(buffer) {
  // The viewer decodes the message and passes it to handle_command, which is intercepted once.
  const handleCommand = viewer.handle_command;
  viewer.handle_command = function (message) {
    viewer.handle_command = handleCommand;
    handleCommand({type: "several", commands: restoreArrays(message.commands, message.arrays)});
  };
  viewer.handle_command_bytearray(new Uint8Array(buffer));
}

new Response(new Blob([packedScene]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer()
  .then(drawScene)
  .catch(function (error) {
    showStatus("this browser cannot read the scene: " + error + "; try a current Firefox or Chromium");
  });
