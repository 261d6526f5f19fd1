// Prints the Khronos validator's report on a GLB as JSON: node validate_glb.mjs <folder of npm packages> <file>
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";

const [packages, file] = process.argv.slice(2);
const validator = createRequire(join(packages, "package.json"))("gltf-validator");
const report = await validator.validateBytes(new Uint8Array(readFileSync(file)), { uri: file, maxIssues: 100 });
console.log(JSON.stringify(report));
