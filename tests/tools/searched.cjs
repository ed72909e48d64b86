// Answers of the site's own search: node searched.cjs SITE QUERY ... prints JSON, for each query its pages in order, each
// a list of sections. It is the script that a browser runs as a worker, with the index that it loads.
const { readdirSync, readFileSync } = require("fs")
const { join, resolve } = require("path")

const [site, ...queries] = process.argv.slice(2)
const workers = resolve(site, "assets/javascripts/workers")
const written = readFileSync(join(site, "search/search_index.js"), "utf8")
const index = JSON.parse(written.slice(written.indexOf("=") + 1))

let hear
const answers = []
global.self = global
global.addEventListener = (_, listener) => (hear = listener)
global.postMessage = (message) => answers.push(message)
require(join(workers, readdirSync(workers).find((name) => name.endsWith(".js"))))

const SETUP = 0, QUERY = 2
const ask = async (type, data) => (await hear({ data: { type, data } }), answers.pop().data)
ask(SETUP, { ...index, options: {} }).then(async () => {
  const found = []
  for (const query of queries) found.push((await ask(QUERY, query)).items.map((page) => page.map((x) => x.location)))
  console.log(JSON.stringify(found))
})
