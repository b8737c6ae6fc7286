// --- answers of a language model ------------------------------------------------------------------

let answered = -2;
$("answers").hidden = !meta.answers.length;
function part(tag, kind, text) {
  const found = document.createElement(tag);
  found.className = kind;
  found.textContent = text;
  return found;
}
function tellAnswer() {
  const now = meta.answers.findLastIndex(answer => answer.time <= t + 1e-6);
  if (!meta.answers.length || now === answered) return;
  answered = now;
  const box = $("answers"), answer = meta.answers[now], heading = part("h2", "", "Answer of the model");
  box.dataset.answer = now;
  if (!answer) return box.replaceChildren(heading, part("p", "faint", "not asked yet"));
  const head = part("p", "said", "");
  head.append(
    part("b", "", answer.action), part("span", answer.good ? "chip" : "chip bad", answer.status),
    part("span", "faint number", `${answer.time.toFixed(1)} s`));
  const more = part("details", "read", "");
  more.open = box.querySelector("details")?.open || false;
  more.append(
    part("summary", "", "What it read"), part("pre", "", answer.scene),
    part("p", "faint", `${answer.spent}; prompt ${answer.prompt}`));
  box.replaceChildren(
    heading, head, ...answer.steps.map(step => part("p", "", `${step.node}: ${step.text}`)),
    part("p", "", answer.text), more);
}
