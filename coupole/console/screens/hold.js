/* A button that moves the arm as long as it is held. Each renewal has the word of the newest answer, so none can be
   sent in advance or wait in the network; the bench stops the arm 300 ms after the last one that it hears. */
(() => {
  const RENEW_MS = 100;
  let held = null;

  const say = words => {
    const said = document.querySelector("[data-name=hand-said]");
    if (said) said.textContent = words;
  };

  function release(words) {
    if (!held) return;
    const {button, socket} = held;
    held = null;
    button.classList.remove("held");
    socket.close();
    say(words);
  }

  function press(button) {
    if (button.disabled) return;
    release("released");
    const {axis, direction} = button.dataset;
    const share = Number(document.querySelector("[data-name=share]").value);
    const asked = {axis, direction: Number(direction), share};
    const socket = new WebSocket(location.origin.replace(/^http/, "ws") + "/api/v1/bench/hold");
    const mine = held = {button, socket};
    button.classList.add("held");
    say(`${button.textContent} is held`);
    const send = request => {
      if (held === mine && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(request));
    };
    socket.onopen = () => send(asked);
    socket.onmessage = event => {
      const said = JSON.parse(event.data);
      if (held !== mine) return;
      if (said.ended) release(`stopped: ${said.ended}`);
      else setTimeout(() => send({...asked, renew: said.renew}), RENEW_MS);
    };
    socket.onclose = () => { if (held === mine) release("stopped: the connection to the console was lost"); };
  }

  const buttonOf = event => event.target instanceof Element ? event.target.closest("[data-axis]") : null;
  document.addEventListener("pointerdown", event => {
    const button = buttonOf(event);
    if (!button || event.button !== 0) return;
    event.target.releasePointerCapture?.(event.pointerId);
    press(button);
  });
  document.addEventListener("keydown", event => {
    const button = buttonOf(event);
    if (!button || ![" ", "Enter"].includes(event.key)) return;
    event.preventDefault();
    if (!event.repeat) press(button);
  });
  const letGo = () => release("released: the arm stops");
  for (const kind of ["pointerup", "pointercancel", "keyup"]) document.addEventListener(kind, letGo);
  document.addEventListener("pointerout", event => {
    if (held && buttonOf(event) === held.button && !held.button.contains(event.relatedTarget)) letGo();
  });
  document.addEventListener("contextmenu", event => { if (buttonOf(event)) event.preventDefault(); });
  document.addEventListener("focusout", event => { if (held && buttonOf(event) === held.button) letGo(); });
  document.addEventListener("visibilitychange", () => { if (document.hidden) release("stopped: the page was hidden"); });
  for (const kind of ["blur", "pagehide"]) window.addEventListener(kind, letGo);
})();
