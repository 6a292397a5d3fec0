// Start of a page that a server sends: the scene comes over a WebSocket. Runs after player.js in the same script.
viewer.connect();
viewer.connection.onclose = function () {
  showStatus("the program that sent this has ended");
};
