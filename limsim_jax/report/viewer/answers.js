// --- answers of a language model ------------------------------------------------------------------

if (meta.answers.length) {
  const box = $("answers");
  const part = (tag, kind, text) => {
    const found = document.createElement(tag);
    found.className = kind;
    found.textContent = text;
    return found;
  };
  let last = -2;
  const tell = () => {
    const now = meta.answers.findLastIndex(answer => answer.time <= t + 1e-6);
    if (now !== last) {
      last = now;
      const answer = meta.answers[now], heading = part("h2", "", "Answer of the model");
      if (!answer) box.replaceChildren(heading, part("p", "faint", "not asked yet"));
      else {
        const head = part("p", "said", "");
        head.append(
          part("b", "", answer.action), part("span", answer.good ? "chip" : "chip bad", answer.status),
          part("span", "faint number", `${answer.time.toFixed(1)} s`));
        const more = document.createElement("details");
        more.className = "read";
        more.open = box.querySelector("details")?.open || false;
        more.append(
          part("summary", "", "What it read"), part("pre", "", answer.scene),
          part("p", "faint", `${answer.spent}; prompt ${answer.prompt}`));
        box.replaceChildren(
          heading, head, ...answer.steps.map(step => part("p", "", `${step.node}: ${step.text}`)),
          part("p", "", answer.text), more);
      }
      box.dataset.answer = now;
    }
    requestAnimationFrame(tell);
  };
  box.hidden = false;
  tell();
}
