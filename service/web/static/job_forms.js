// Forms that queue a job, on the results of a finished one or on files; files are sent first.

import { notify } from "./app.js";
import { SentFiles } from "./form_parts.js";
import { answer, filesOf, queueJob, readOptions } from "./options.js";

for (const form of document.querySelectorAll("form.job-form")) {
    const fault = form.querySelector(".fault"), state = form.querySelector("[role=status]"), button = form.querySelector("[type=submit]");
    const say = (words) => { state.textContent = words; state.hidden = !words; };
    const sent = new SentFiles(form.dataset.kind, Number(form.dataset.maxFile), say);
    form.addEventListener("submit", async (event) => {
        event.preventDefault();
        button.disabled = true;
        fault.hidden = true;
        try {
            const body = { kind: form.dataset.kind, options: readOptions(form) };
            if (form.dataset.source) body.source_id = form.dataset.source;
            const files = filesOf(form);
            if (files.length) body.files_id = await sent.dataset(files);
            location.href = `/jobs/${await queueJob(body, crypto.randomUUID?.() ?? String(Math.random()))}`;
        } catch (error) {
            fault.textContent = [error.message, ...(error.faults ?? [])].join(" ");
            fault.hidden = false;
            button.disabled = false;
            say("");
            notify("It was not queued.", true);
        }
    });
}

/** A stopped reconstruction goes on, and writes other files in the end. */
document.querySelector("#go-on form")?.addEventListener("submit", async (event) => {
    event.preventDefault();
    const form = event.target, fault = form.querySelector(".fault");
    fault.hidden = true;
    try {
        await answer(await fetch(`/v1/jobs/${form.dataset.job}/retry`, {
            method: "POST",
            headers: { "Content-Type": "application/json", "Idempotency-Key": crypto.randomUUID?.() ?? String(Math.random()) },
            body: JSON.stringify({ from: "checkpoint", options: readOptions(form) }),
        }));
        location.reload();
    } catch (error) {
        fault.textContent = [error.message, ...(error.faults ?? [])].join(" ");
        fault.hidden = false;
    }
});
