// Names of files that are sent, and of what is made of them.

/** What a file is called by options: plain letters, which every system takes; null where there is none. */
export function plainName(file, otherwise) {
    if (!file) return null;
    const clean = file.name.replace(/[^A-Za-z0-9._-]+/g, "_").replace(/^[._-]+/, "").slice(-80);
    return clean.replace(/\.[^.]*$/, (suffix) => suffix.toLowerCase()) || otherwise;
}

/** What a dataset or a job can be called: 200 characters. */
export function shortName(name) {
    return [...name].slice(0, 200).join("");
}
